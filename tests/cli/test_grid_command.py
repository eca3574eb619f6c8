import pytest

from kiteline_cli import main as cli


def test_grid_without_eval_says_how(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["grid"]) == 2
    assert "eval EST.yaml TRUE.yaml" in capsys.readouterr().err
    assert cli.main(["grid", "--help"]) == 0
    assert "the shortest path on which a vehicle touches nothing" in capsys.readouterr().out
    assert cli.main(["grid", "paht"]) == 2
    assert "no verb 'paht': expected eval, path, truth" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("action", "word"), [("eval", "EST.yaml"), ("path", "--through-unknown"), ("truth", "--boxes")]
)
def test_grid_reaches_its_actions(action: str, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["grid", action, "--help"])
    assert left.value.code == 0
    assert word in capsys.readouterr().out


@pytest.mark.parametrize("options", [["--seed", "-1"], ["--transform", "nan", "0", "0"], ["--robot-radius", "nan"]])
def test_grid_eval_refuses_numbers_that_mean_nothing(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["grid", "eval", "a.yaml", "b.yaml", *options])
    assert left.value.code == 2
    assert "expected" in capsys.readouterr().err
