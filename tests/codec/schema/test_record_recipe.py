"""The recipe of CONTRIBUTING.md, "A record": one module and one line make a record that crosses a channel."""

import shutil
import subprocess
import sys
from pathlib import Path

import kiteline_codec
import kiteline_core

MODULE = '''
"""The battery of an agent."""

from dataclasses import dataclass
from typing import Self

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.ids import AgentId


@register
@dataclass(frozen=True, slots=True)
class Battery(Record):
    """Charge of an agent's battery in percent."""

    KIND = 15
    ID = IdOf.AGENT
    PRIORITY = Priority.CORRECTION

    agent: AgentId
    percent: int

    def write(self, out: Writer) -> None:
        """Append the charge."""
        out.varint(self.percent)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        return cls(AgentId(key.id), source.varint(100))
'''
LINE = "from kiteline_codec.schema.agent.battery import Battery as Battery\n"
FLIGHT = """
from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import AGENT_KINDS, Battery, GridTile, messages
from kiteline_codec.sync.config import default_order
from kiteline_core.ids import AgentId

agent, base = coded_channel(1), coded_channel(1)
agent.put(Battery(AgentId(5), 71))
received = []
for tick in range(8):
    received += base.receive(agent.poll(tick * 50_000_000), tick * 50_000_000)
    agent.receive(base.poll(tick * 50_000_000), tick * 50_000_000)
assert agent.endpoint.digest_equal and base.undecodable == 0
assert Battery.KIND in AGENT_KINDS
assert default_order(messages.key(received[0])) < default_order(messages.Key(GridTile.KIND, 0))
print(received)
"""


def test_a_record_is_one_module_and_one_line(tmp_path: Path) -> None:
    package = tmp_path / "kiteline_codec"
    shutil.copytree(Path(kiteline_codec.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "schema" / "agent" / "battery.py").write_text(MODULE)
    with (package / "schema" / "__init__.py").open("r+") as table:
        text = table.read()
        table.seek(0)
        table.write(text.replace("from kiteline_codec.schema.agent", LINE + "from kiteline_codec.schema.agent", 1))
    core = Path(kiteline_core.__file__).parents[1]
    environment = {"PYTHONPATH": f"{tmp_path}:{core}", "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[Battery(agent=5, percent=71)]\n"
