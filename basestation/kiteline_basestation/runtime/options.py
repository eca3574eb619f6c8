"""Options of the base process, from the command line or from `fly`; its configuration and channels."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass

from kiteline_basestation.config import BaseConfig
from kiteline_codec.channel import RecordChannel, coded_channel
from kiteline_codec.transport.link_traits import LinkTraits
from kiteline_codec.transport.seal import seal_bytes, suite_for
from kiteline_core import config as configuration
from kiteline_core.arguments import count_limit
from kiteline_core.ids import AgentId

DEFAULT_LINK = "zenoh:tcp/127.0.0.1:7447"
LOG_STEM = "session"  # of the names of logs of `kiteline base --log`
LOG_MIB = 4000  # MiB of logs by default: days of flights, as they hold no images
MOST_WORKERS = 16


@dataclass(frozen=True, slots=True)
class BaseOptions:
    """Options of the base process. Plain values that JSON can hold."""

    folder: str  # for the log, the map and the grid
    log_name: str = "log.mcap"
    log_mib: int = 0  # MiB that this log and earlier ones in the folder may take; 0: no limit
    log_optional: bool = False  # begin also where no log can be written
    agents: tuple[int, ...] = ()
    session: int = 1  # higher than that of any base before it
    link: str = "none"  # LINK, or lockstep:ENDPOINT
    config: str = ""  # a TOML file
    start_ns: int = 0  # time stamp of flight time 0: the log uses the time of the first source
    down_bytes_s: int = 0  # B/s to each agent; 0: no limit
    key: str = ""  # a file with the agents' keys; "": packets are not sealed
    paired_only: bool = False  # take no connection of anyone without a key (zenoh)
    told: tuple[str, ...] = ()  # lines about that for the user
    profile: str = ""  # wifi or radio; "": by the link's throughput
    delay_s: float = 0.0  # s; modelled delay of the link
    loss: float = 0.0  # probability that a packet is lost
    disorder: float = 0.0  # probability that a packet is duplicated, and that it is reordered
    seed: int = 0
    kill_at_s: float | None = None  # s of flight time at which the process is killed; None: never
    kill_delay_s: float = 0.0  # s of real time after that
    store: str = ""
    imports: tuple[str, ...] = ()
    web: str = ""
    quiet: bool = False  # no status messages
    workers: int = 0  # processes for jobs; 0: as the machine has cores
    cpu_percent: float = 0.0  # of one core, for its steps and jobs in modelled time; 0: each its own, steps take none
    maps: str = ""  # a Zenoh endpoint for `kiteline maps`; "": the agents' link


def base_config(path: str) -> BaseConfig:
    """The configuration, with the [base] table of a TOML file in place of the defaults. Raises ConfigError."""
    if not path:
        return BaseConfig()
    with open(path, "rb") as file:
        return configuration.load(BaseConfig(), file.read(configuration.MOST_BYTES), "base", path)


def parser(link_forms: str = "") -> argparse.ArgumentParser:
    """The arguments of `kiteline base`. link_forms: of LINK, for the help text."""
    p = argparse.ArgumentParser(
        prog="kiteline base",
        description="The base station: refines and merges the maps of any number of agents, "
        "and sends corrections back.",
        epilog=f"LINK is {link_forms}. The address 0.0.0.0 listens on all interfaces.",
    )
    p.add_argument("--link", metavar="LINK", default=DEFAULT_LINK, help="link to the agents (default: %(default)s)")
    p.add_argument("--store", metavar="DIR", default="", help="save the map here, and resume from it")
    p.add_argument("--import", dest="imports", metavar="LOG", nargs="+", default=[], action="extend",
                   help="add agents' logs, for what no link carried; or maps: a store, a base's log")  # fmt: skip
    p.add_argument("--maps", metavar="ENDPOINT", default="",
                   help="answer `kiteline maps` here: tcp/HOST:PORT (default: on an IP link)")  # fmt: skip
    p.add_argument("--web", metavar="HOST:PORT", default="", help="serve a status page")
    p.add_argument("--config", metavar="F", default="", help="a TOML file with a [base] section")
    p.add_argument("--log", metavar="DIR", default="", help="log each start to DIR; the map is left there too")
    p.add_argument("--log-mib", metavar="N", type=count_limit, default=LOG_MIB,
                   help="MiB that the logs of all starts may take: the oldest are deleted, also while the base runs "
                   "(default: %(default)s; 0: no limit)")  # fmt: skip
    p.add_argument("--down-bytes", metavar="N", type=count_limit, default=0, help="B/s to each agent, headers included")
    p.add_argument("--key", metavar="FILE", default="", help="seal packets; drop those of agents without a key in it "
                   "(default, beyond this machine: a file that is made at the first start)")  # fmt: skip
    p.set_defaults(told=())
    p.add_argument("--insecure", action="store_true", help="serve anyone who reaches the link, without seals")
    p.add_argument("--paired-only", action="store_true",
                   help="take no connection of anyone without a key in the file (IP links): strangers take up no "
                   "place, and 288 may connect, not 96; new keys count from the next start")  # fmt: skip
    p.add_argument("--profile", choices=("wifi", "radio"), default="", help="default: as the link allows")
    p.add_argument("--workers", metavar="N", type=_workers, default=0,
                   help=f"processes for long work, 1 to {MOST_WORKERS} (default: by cores, 2 to 4)")  # fmt: skip
    p.add_argument("--quiet", action="store_true", help="print no status messages")
    p.add_argument("--spec", metavar="JSON", default="", help=argparse.SUPPRESS)
    return p


def _workers(text: str) -> int:
    """A number of workers; 0 is the default's."""
    if not (text.isascii() and text.isdecimal() and len(text) < 5 and int(text) <= MOST_WORKERS):
        raise argparse.ArgumentTypeError(f"{text[:20]!r}: expected 0 to {MOST_WORKERS}; more do not help one loop")
    return int(text)


def options_of(a: argparse.Namespace, session: int) -> BaseOptions:
    """Options from the command line."""
    return BaseOptions(
        folder=a.log, log_name=f"{LOG_STEM}{session}.mcap" if a.log else "", log_mib=a.log_mib, log_optional=True,
        session=session,
        link=a.link, config=a.config, down_bytes_s=a.down_bytes, profile=a.profile, key=a.key, told=a.told,
        paired_only=a.paired_only,
        store=a.store, web=a.web,
        imports=tuple(a.imports), maps=a.maps, quiet=a.quiet, workers=a.workers,
    )  # fmt: skip


def coded_channels(spec: BaseOptions, link: LinkTraits) -> Callable[[AgentId], RecordChannel]:
    """A function that opens the base's end of the channel to an agent. Raises BudgetError."""

    def opened(agent: AgentId) -> RecordChannel:
        sealed = seal_bytes(suite_for(link), agent) if spec.key else 0
        return coded_channel(spec.session, spec.down_bytes_s, spec.profile, sealed, link, peer=agent)

    opened(AgentId(0))  # so that a budget that is too small is told now, not when the first agent connects
    return opened
