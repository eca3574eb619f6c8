"""Options of the base that are refused, and who may connect where maps are asked for."""

import contextlib
from typing import Any

import pytest

from kiteline_basestation.__main__ import main
from kiteline_basestation.runtime import options, questions
from kiteline_basestation.runtime.options import MOST_WORKERS, BaseOptions
from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.links.no_link import open_base_end


@pytest.mark.parametrize("workers", [str(MOST_WORKERS + 1), "-1", "two", "9" * 5000])
def test_a_number_of_workers_that_no_machine_bears_is_refused(workers: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        options.parser().parse_args(["--workers", workers])
    assert f"expected 0 to {MOST_WORKERS}" in capsys.readouterr().err


@pytest.mark.parametrize("given", [["--down-bytes", "-1"], ["--log-mib", "-4"]])
def test_negative_limits_are_refused(given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(given)
    assert f"{': '.join(given)}: expected 0" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("endpoint", "guarded"), [("tcp/0.0.0.0:7448", True), ("zenoh:tcp/10.0.0.4:7448", True), ("tcp/127.0.0.1:1", False)]
)
def test_an_open_endpoint_for_maps_takes_connections_of_the_paired_only(
    endpoint: str, guarded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[dict[str, Any]] = []

    class Server:
        def __init__(self, service: str, **given: Any) -> None:
            opened.append(given)

        def close(self) -> None: ...

    monkeypatch.setattr(questions, "QueryServer", Server)
    with contextlib.ExitStack() as stack:
        questions.Questions(
            BaseOptions("", maps=endpoint),
            open_base_end("", LinkOptions()),
            stack,
            dict,
            lambda: None,
            {"maps": "secret"},
        )  # fmt: skip
    assert opened[0]["logins"] == ({"maps": "secret"} if guarded else None)
