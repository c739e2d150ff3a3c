import pytest

from tests.support.runs_on_disk import write_run

KINDS = "accuracy_time, price_list, paper, ablation, minutes, methods, effects, search, table, compare, run"


@pytest.mark.slow
def test_pages_are_written_and_named(ok, in_tmp):
    write_run("runs/accuracy_time")
    for kind, page in (("accuracy_time", "accuracy-time.md"), ("price_list", "price-list.md")):
        done = ok("report", f"kind={kind}", "out=out")
        assert done.out.splitlines()[0] == f"written: out/{page}"
        assert (in_tmp / "out" / page).read_text().startswith("# ")


@pytest.mark.parametrize("typed", ["runs [1]", "runs [1]/*", "[runs [1]/a[b],runs [1]/c]", "runs [1]/a[b]"])
def test_names_of_folders_may_have_brackets(ok, in_tmp, typed):
    for name, scene in (("a[b]", "one"), ("ab", "two"), ("c", "three")):  # as a pattern a[b] is ab
        write_run(f"runs [1]/{name}", scene=scene)
    ok("report", "kind=table", f"runs={typed}", "rows=scene", "out=out")
    rows = (in_tmp / "out" / "table.csv").read_text().splitlines()[1:]
    wanted = {"runs [1]/a[b]": {"one"}, "[runs [1]/a[b],runs [1]/c]": {"one", "three"}}
    assert {row.split(",")[0] for row in rows} == wanted.get(typed, {"one", "two", "three"})


def test_the_help_has_a_line_for_each_kind(forewarp):
    text = forewarp("report", "--help").out
    for kind in KINDS.split(", "):
        assert len([line for line in text.splitlines() if line.split()[:1] == [f"kind={kind}"]]) == 1


@pytest.mark.slow
def test_without_a_kind_nothing_is_written_but_the_help(forewarp, in_tmp):
    write_run("runs/accuracy_time")
    done = forewarp("report")
    assert done.status == 2
    assert "kind=accuracy_time" in done.out
    assert forewarp("report", "--help").out.startswith(done.out)
    told = "kind: expected the kind of page, but got nothing; type kind=NAME"
    assert done.err == f"forewarp-report: error: {told}, one of the above\n"
    assert not (in_tmp / "runs/accuracy_time/results").exists()


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["kind=prices"],
            f"kind: expected {KINDS.replace(', run', ' or run')}, but got",
        ),
        (["runs=runs"], "kind: expected the kind of page, but got nothing; type kind=NAME"),
        (["kind=table", "target=high"], "target: expected a number of dB or null, but got 'high'"),
        (["kind=minutes"], "runs: expected a folder with runs, but got runs/minutes, which is not there"),
        (["kind=minutes", "published=none.yaml"], "none.yaml: expected a usable file or folder, but got No"),
        (["kind=paper", "runs=[a,b]"], "runs: expected one folder for kind=paper, but got a list"),
        (["kind=compare"], "runs: expected folders of runs, but got none; set runs="),
    ],
)
def test_mistakes_end_in_one_line(refused, in_tmp, arguments, line):
    assert line in refused("report", "out=out", *arguments)
    assert not (in_tmp / "out").exists()
