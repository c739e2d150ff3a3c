import json

import pytest

from forewarp.cli.compare import main, named


def metrics(method, psnr=30.0, **more):
    return {
        "protocol": {"method": method},
        "seconds": {"train": 60.0},
        "test": {"all": {"psnr": psnr}},
    } | more


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Call with folder -> content of its metrics.json; the current directory holds the folders."""
    monkeypatch.chdir(tmp_path)

    def write(**contents):
        for name, content in contents.items():
            (tmp_path / name).mkdir()
            text = content if isinstance(content, str) else json.dumps(content)
            (tmp_path / name / "metrics.json").write_text(text)
        return list(contents)

    return write


def test_two_runs_side_by_side_with_their_difference(runs, capsys):
    flow = {"flow": {"epe_moving": 0.1, "motion_mean": 0.4}}
    main(runs(one=metrics("forward", 31.5, **flow), two=metrics("backward", 30.0, **flow)))
    words = capsys.readouterr().out.split()
    assert words[:8] == ["PSNR", "(dB)", "of", "held-out", "views", "forward", "backward", "difference"]
    assert {"31.50", "30.00", "+1.50", "25%", "+0%", "60"} <= set(words)


def test_steps_of_all_stages_where_every_run_noted_them(runs, capsys):
    steps = {"steps": {"coarse": 400, "fine": 900}}
    folders = runs(one=metrics("forward", **steps), two=metrics("backward", **steps), old=metrics("forward"))
    main(folders[:2])
    assert "steps 1,300 1,300" in " ".join(capsys.readouterr().out.split())
    main(folders)
    assert "steps" not in capsys.readouterr().out


def test_every_run_of_one_method_has_a_column_of_its_own(runs, capsys):
    main(runs(seed0=metrics("forward", 31.0), seed1=metrics("forward", 32.0)))
    out = capsys.readouterr().out
    assert all(word in out for word in ("seed0", "seed1", "31.00", "32.00", "-1.00"))


@pytest.mark.parametrize(
    ("folders", "methods", "names"),
    [
        (["a/x", "b/y"], ["forward", "backward"], ["forward", "backward"]),
        (["a/x", "b/y"], ["forward", "forward"], ["x", "y"]),
        (["a/x", "b/x"], ["forward", "forward"], ["a/x", "b/x"]),
        (["a/x", "a/x"], ["forward", "forward"], ["1 a/x", "2 a/x"]),
    ],
)
def test_columns_are_named_as_far_as_needed(folders, methods, names):
    assert list(named(folders, [metrics(method) for method in methods])) == names


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (None, "run/metrics.json: expected the numbers of a run, but got No such file or directory; make"),
        ("{", "run/metrics.json: expected the key protocol, but got none; make it anew with forewarp-eval"),
        ("[]", "run/metrics.json: expected the key protocol, but got none"),
        ({"protocol": {}, "test": {}}, "run/metrics.json: expected the key seconds, but got none"),
    ],
)
def test_what_is_no_run_ends_in_one_line(runs, capsys, content, line):
    if content is not None:
        runs(run=content)
    with pytest.raises(SystemExit) as leaving:
        main(["run"])
    err = capsys.readouterr().err
    assert leaving.value.code == 2
    assert err.startswith(f"forewarp.cli.compare: error: {line}")
    assert err.count("\n") == 1


def test_no_runs_are_named(capsys):
    with pytest.raises(SystemExit):
        main([])
    assert capsys.readouterr().err == (
        "forewarp.cli.compare: error: expected folders of runs, but got none; name two\n"
    )
