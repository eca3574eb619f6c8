"""The shape of the sources: sizes of folders and files, import circles, lines."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
ROOMS = ("core", "codec", "hw", "agent", "basestation", "lab", "bench", "cli")

_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")  # fields of a statement that hold statements

Graph = Mapping[str, set[str]]


@dataclass(frozen=True, slots=True)
class Sources:
    """The modules of all rooms: dotted name (a package's without __init__) and file."""

    files: dict[str, Path]

    @classmethod
    def of(cls, root: Path, rooms: Iterable[str] = ROOMS) -> Sources:
        """The modules below root/ROOM/kiteline_ROOM."""
        files = {}
        for room in rooms:
            for path in sorted((root / room).glob(f"kiteline_{room}/**/*.py")):
                parts = path.relative_to(root / room).with_suffix("").parts
                files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
        return cls(files)

    def lines(self) -> dict[str, int]:
        """Lines of each module."""
        return {name: len(path.read_text().splitlines()) for name, path in self.files.items()}

    def folder_sizes(self) -> Counter[str]:
        """Number of modules in each folder, without __init__."""
        return Counter(str(path.parent) for path in self.files.values() if path.name != "__init__.py")

    def imports(self) -> dict[str, set[str]]:
        """Modules that each module imports anywhere in its text, under TYPE_CHECKING too; without packages."""
        packages = {name for name, path in self.files.items() if path.name == "__init__.py"}
        return {
            name: {module for module in self._imported(path) if module not in packages and module != name}
            for name, path in self.files.items()
            if name not in packages
        }

    def _imported(self, path: Path) -> set[str]:
        found, nodes = set(), list[ast.AST](ast.parse(path.read_text()).body)
        while nodes:
            node = nodes.pop()
            # statements alone: most of a tree is expressions, in which nothing is imported
            nodes += [one for block in _BLOCKS for one in getattr(node, block, ())]
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            found |= {name for name in names if name in self.files}
        return found


def by_sub_package(graph: Graph) -> dict[str, set[str]]:
    """The graph between sub-packages; a module at a room's top stands for itself."""
    out: dict[str, set[str]] = {}
    for name, imported in graph.items():
        here = _sub_package(name)
        out.setdefault(here, set()).update(there for module in imported if (there := _sub_package(module)) != here)
    return out


def _sub_package(module: str) -> str:
    return ".".join(module.split(".")[:2])


def circles(graph: Graph) -> list[list[str]]:
    """Groups of nodes that reach each other (strongly connected components, by Tarjan's algorithm), sorted."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(graph.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = [stack.pop()]
            while group[-1] != node:
                group.append(stack.pop())
            if len(group) > 1:
                found.append(sorted(group))

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return sorted(found)
