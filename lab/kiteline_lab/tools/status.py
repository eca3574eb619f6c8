"""`kiteline status`: what a running base does, in a few lines."""

import argparse
import sys
import time
from collections.abc import Mapping
from typing import Any

from kiteline_hw.ports import LinkError
from kiteline_lab.tools.maps import DEFAULT_BASE, add_options, ask_base, columns

_WATCH_S, _MOST_WATCH_S = 2.0, 86400.0  # s between two reports


def parser() -> argparse.ArgumentParser:
    """The arguments of `kiteline status`."""
    p = argparse.ArgumentParser(
        prog="kiteline status",
        description="Ask a running base what it does: agents and their links, map, store, and what is wrong.",
        epilog="Exit status: 0 all is well, 1 something is wrong, 2 no base answers. A base on a serial line or "
        "MAVLink answers where its --maps says. The status page (`kiteline base --web`) shows the same with the map.",
    )
    add_options(p, endpoint=DEFAULT_BASE, key=None, as_json=False)
    p.add_argument("--watch", metavar="S", type=float, nargs="?", const=_WATCH_S,
                   help=f"ask again every S seconds (default: {_WATCH_S:g}) until Ctrl-C")  # fmt: skip
    return p


def lines(report: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> list[str]:
    """A report as lines of text. before: an earlier one, for rates. Raises KeyError, TypeError for other content."""
    store = report["store"]
    kept = "the map is not saved" if store is None else f"store {store['folder']}"
    if store is not None and not store["up_to_date"]:
        kept += " not up to date"
    out = [
        f"base on {report['link']}, session {report['session']}, up {_span(report['up_s'])}; {kept}",
        ", ".join(
            [*(f"{n['label'].lower()} {n['value']}{' ' * bool(n['unit'])}{n['unit']}" for n in report["totals"]),
             f"peak memory {report['memory_mib']:.0f} MiB"]
        ),
    ]  # fmt: skip
    if report["agents"]:
        rows = [_agent(agent, _rates(agent, report, before)) for agent in report["agents"]]
        out += columns([_HEAD, *rows])
    else:
        out.append("no agent yet")
    return [*out, *(f"wrong: {trouble}" for trouble in report["troubles"])]


_HEAD = ("agent", "link", "quality", "x y z in w, m", "keyframes", "landmarks", "submaps", "kB up", "kB down", "kB/s")


def _agent(agent: Mapping[str, Any], rates: tuple[float, float] | None) -> tuple[str, ...]:
    """The row of an agent. rates: up and down, kB/s."""
    silent_s = agent["silent_s"]
    link = agent["link"] if silent_s is None or agent["link"] == "live" else f"{agent['link']}, {_span(silent_s)}"
    quality, position = agent["quality"], agent["position"]
    unit = " (own unit)" if agent["unit"] == "own" else ""
    counts = {number["label"]: str(number["value"]) for number in agent["counts"]}
    return (
        str(agent["agent"]),
        link,
        "-" if quality is None else "no pose" if quality < 0 else str(quality),
        "not placed" if position is None else " ".join(f"{v:.2f}" for v in position) + unit,
        counts["Keyframes"],
        counts["Landmarks"],
        counts["Submaps"],
        f"{agent['bytes_up'] / 1000:.0f}",
        f"{agent['bytes_down'] / 1000:.0f}",
        "-" if rates is None else f"{rates[0]:.1f}, {rates[1]:.1f}",
    )


def _rates(
    agent: Mapping[str, Any], report: Mapping[str, Any], before: Mapping[str, Any] | None
) -> tuple[float, float] | None:
    """Rates of an agent's link since an earlier report of the same base, kB/s up and down."""
    if before is None or before["session"] != report["session"] or report["up_s"] <= before["up_s"]:
        return None
    span_s = report["up_s"] - before["up_s"]
    for old in before["agents"]:
        if old["agent"] == agent["agent"]:
            up, down = (agent[way] - old[way] for way in ("bytes_up", "bytes_down"))
            return up / 1000 / span_s, down / 1000 / span_s
    return None


def _span(seconds: float) -> str:
    """A time span for people."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02} min"


def main(argv: list[str]) -> int:
    """Run `kiteline status`; exit status 1 if something is wrong. Raises LinkError."""
    a = parser().parse_args(argv)
    if a.watch is not None and not 0.0 < a.watch <= _MOST_WATCH_S:
        parser().error(f"--watch {a.watch:g}: expected more than 0 and at most {_MOST_WATCH_S:g} seconds")
    before: Mapping[str, Any] | None = None
    while True:
        ok, text, report = ask_base(a.base, a.key, "status", "{}")
        try:
            shown = lines(report, before) if ok else [f"kiteline status: {report['error']}"]
        except (KeyError, TypeError, ValueError, AttributeError):
            raise LinkError(f"{a.base} answers {text[:60]!r}, which is no status of a base") from None
        out = sys.stdout if ok else sys.stderr
        print(text if a.json else "\n".join(shown), file=out, flush=True)
        if a.watch is None or not ok:
            return 0 if ok and not report["troubles"] else 1
        before = report
        try:
            time.sleep(a.watch)
        except KeyboardInterrupt:
            return 0
        if not a.json:
            print()
