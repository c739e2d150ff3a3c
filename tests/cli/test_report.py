import pytest

from tests.support.runs_on_disk import write_run


def test_pages_are_written_and_named(forewarp, in_tmp):
    write_run("runs/accuracy_time")
    for kind, page in (("accuracy_time", "accuracy-time.md"), ("price_list", "price-list.md")):
        done = forewarp("report", f"kind={kind}", "out=out")
        assert done.status == 0, done.err
        assert done.out.splitlines()[0] == f"written: out/{page}"
        assert (in_tmp / "out" / page).read_text().startswith("# ")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["kind=prices"], "kind: expected one of accuracy_time, price_list, paper, effects, but got"),
        (["target=high"], "target: expected a number of dB or null, but got 'high'"),
        ([], "runs/accuracy_time: expected folders of runs, but got none"),
        (["published=none.yaml"], "none.yaml: expected a usable file or folder, but got No such file"),
    ],
)
def test_mistakes_end_in_one_line(refused, in_tmp, arguments, line):
    assert line in refused("report", "out=out", *arguments)
    assert not (in_tmp / "out").exists()
