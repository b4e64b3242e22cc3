"""The rooms of the package: who may import whom, and the rules that a linter does not know.

python -m tests.test_architecture      draws docs/images/architecture.svg from the imports
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from itertools import groupby
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "quest"
FILES = sorted(SOURCE.rglob("*.py"))
MODULES = {
    ".".join(("quest", *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in FILES
}

RANKS = {
    **dict.fromkeys(["geometry"], 0),
    **dict.fromkeys(["sim", "data", "model", "monitor", "filter"], 1),
    "text": 2,
    **dict.fromkeys(["train", "track"], 3),
    "paper": 4,
    "baselines": 5,
    **dict.fromkeys(["evaluation", "viz"], 6),
    **dict.fromkeys(["bench", "live"], 7),
    "cli": 8,
}
"""Rooms may import rooms of lower rank. Modules at the package's root, such as types and errors, have rank 0.

``paper`` stands on the losses and windows of ``train``, and its ``load`` gives our tracker where weights are ours.
Neither ``train`` nor ``track`` knows of it: the command line and tables of results name its network by its preset.
"""

ALLOWED_WITHIN_RANK = {("sim", "data")}
"""Generated takes go into the store."""

MAX_FUNCTION_LINES = 60


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


@cache
def nodes(path: Path) -> list[ast.AST]:
    """Everything in a file, at any depth."""
    return list(ast.walk(tree(path)))


def name(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


def room(module_parts: tuple[str, ...]) -> str:
    """Room of a module given by its parts below ``quest``; modules at the root are their own room."""
    return module_parts[0] if module_parts else "__init__"


def room_of_file(path: Path) -> str:
    return room(path.relative_to(SOURCE).with_suffix("").parts)


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and dotted name of everything that a file imports, at any depth."""
    package = ("quest", *path.relative_to(SOURCE).parent.parts)
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            if module == "quest":
                yield from ((node.lineno, f"quest.{alias.name}") for alias in node.names)
            else:
                yield node.lineno, module


def may_import(importer: str, imported: str) -> bool:
    if importer in (imported, "__init__", "__main__") or (importer, imported) in ALLOWED_WITHIN_RANK:
        return True  # the package's own __init__ and __main__ are the public doors: they open onto every room
    low, high = RANKS.get(imported, 0), RANKS.get(importer, 0)
    return low < high or low == high == 0


PICTURE = Path(__file__).parents[1] / "docs" / "images" / "architecture.svg"
_STYLE = (
    ".f{fill:#f4f6f9} .b{fill:#fff;stroke:#456;stroke-width:1.5} .t{font-weight:bold} .s{fill:#678;font-size:12px}"
    ".a{fill:none;stroke:#89a;stroke-width:1.3;marker-end:url(#h)}"
)
_ARROW = (
    '<defs><marker id="h" markerWidth="8" markerHeight="8" refX="7" refY="4" orient="auto">'
    '<path d="M0,0 L8,4 L0,8 z" fill="#89a"/></marker></defs>'
)


def imported_rooms() -> dict[str, set[str]]:
    """The rooms that the modules of each room import."""
    found: dict[str, set[str]] = {importer: set() for importer in RANKS}
    for path in FILES:
        of_quest = (module.split(".") for _, module in imports(path) if module.startswith("quest."))
        found.get(room_of_file(path), set()).update(parts[1] for parts in of_quest if parts[1] in RANKS)
    return {importer: imported - {importer} for importer, imported in found.items()}


def drawn() -> str:
    """The rooms on their floors, with an arrow to each room that is imported and not by way of another one."""
    imported, width, height = imported_rooms(), 960, 78
    floors = [[*rooms] for _, rooms in groupby(sorted(RANKS, key=RANKS.__getitem__), RANKS.__getitem__)]
    bands, arrows, boxes, at = [], [], [], {}
    for i, rooms in enumerate(floors):
        y = (len(floors) - 1 - i) * height
        bands.append(f'<rect class="f" y="{y + 2}" width="{width}" height="{height - 4}"/>')
        bands.append(f'<text class="s" x="14" y="{y + height // 2 + 4}">floor {i}</text>')
        for j, each in enumerate(rooms):  # shifted, so that arrows pass beside the rooms of other floors
            at[each] = 80 + (width - 80) * (2 * j + 1) // (2 * len(rooms)) + 70 * (i % 3 - 1), y + height // 2

    def under(importer: str) -> set[str]:
        return imported[importer].union(*map(under, imported[importer]))

    for importer, (x, y) in at.items():
        boxes.append(f'<rect class="b" x="{x - 55}" y="{y - 15}" width="110" height="30" rx="6"/>')
        boxes.append(f'<text class="t" x="{x}" y="{y + 5}" text-anchor="middle">{importer}</text>')
        for u, v in (at[other] for other in sorted(imported[importer] - set().union(*map(under, imported[importer])))):
            across, down = (0, 15) if v > y else (55 if u > x else -55, 0)
            arrows.append(f'<path class="a" d="M{x + across},{y + down} L{u - across},{v - down}"/>')
    size = f'viewBox="0 0 {width} {height * len(floors)}" font-family="sans-serif" font-size="14"'
    title = "<title>The rooms of the package on their floors, and which of them import which</title>"
    ground = f'<rect width="{width}" height="{height * len(floors)}" fill="#fff"/>'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{title}<style>{_STYLE}</style>{_ARROW}{ground}'
    return "\n".join([head, *bands, *arrows, *boxes, "</svg>"]) + "\n"


@pytest.mark.slow
def test_the_picture_of_the_rooms_is_up_to_date():
    assert PICTURE.read_text(encoding="utf-8") == drawn(), "run `python -m tests.test_architecture`"


def test_every_room_has_a_rank():
    rooms = {path.name for path in SOURCE.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert rooms <= set(RANKS), "a new room: give it a rank (and a line in the docs)"


@pytest.mark.slow
def test_imports_point_one_way():
    wrong = [
        f"{name(path)}:{line} imports {module}"
        for path in FILES
        for line, module in imports(path)
        if module.startswith("quest.") and not may_import(room_of_file(path), room(tuple(module.split(".")[1:])))
    ]
    assert not wrong


def imported_modules(path: Path) -> Iterator[str]:
    """Modules of this package that a file imports anywhere in it, also for type checkers alone.

    ``from quest.data import folder`` is of the module, ``from quest import __version__`` of the package.
    """
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in MODULES)
        elif isinstance(node, ast.ImportFrom) and node.module in MODULES:
            named = (f"{node.module}.{alias.name}" for alias in node.names)
            yield from (module if module in MODULES else node.module for module in named)


def circle(imported: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle; none if there is no circle."""
    try:
        TopologicalSorter(imported).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_no_module_imports_itself_by_a_detour():
    assert not circle({module: set(imported_modules(path)) for module, path in MODULES.items()})


def test_circle_rule_itself():
    assert circle({"store": {"folder", "bucket"}, "bucket": {"folder"}, "folder": set()}) == []
    assert set(circle({"store": {"folder"}, "folder": {"bucket"}, "bucket": {"folder"}})) == {"folder", "bucket"}


def test_import_rule_itself():
    assert may_import("cli", "evaluation")
    assert may_import("sim", "data")
    assert may_import("types", "errors")
    assert not may_import("data", "sim")
    assert not may_import("model", "data")
    assert not may_import("errors", "data")
    assert not may_import("geometry", "cli")


def test_only_sim_imports_sapien():
    wrong = [
        f"{name(path)}:{line}"
        for path in FILES
        for line, module in imports(path)
        if module.partition(".")[0] == "sapien" and room_of_file(path) != "sim"
    ]
    assert not wrong


def test_no_pickles():
    """Weights and checkpoints are safetensors: reading them must not run code.

    One published pickle is turned into safetensors; it is known by its hash, and of it torch builds tensors alone.
    """
    wrong = [
        f"{name(path)}:{line} imports {module}"
        for path in FILES
        for line, module in imports(path)
        if module.partition(".")[0] in ("pickle", "dill", "cloudpickle", "joblib")
    ]
    for path in FILES:
        for node in nodes(path):
            if isinstance(node, ast.Attribute) and ast.unparse(node) in ("torch.load", "torch.save"):
                wrong.append(f"{name(path)} uses {ast.unparse(node)}")
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False":
                wrong.append(f"{name(path)}:{node.value.lineno} allows pickles")
    assert wrong == ["model/import_detail.py uses torch.load"]
    assert "weights_only=True" in (SOURCE / "model" / "import_detail.py").read_text(encoding="utf-8")


def test_no_rooms_without_a_name():
    assert not [name(path) for path in FILES if path.stem in ("utils", "helpers", "common", "misc")]


def test_functions_are_short():
    long = []
    for path in FILES:
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = code_lines(node)
                if lines > MAX_FUNCTION_LINES:
                    long.append(
                        f"{name(path)}:{node.lineno} {node.name} has {lines} lines (at most {MAX_FUNCTION_LINES})"
                    )
    assert not long


def code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring: explaining more must not cost anything."""
    first = function.body[0]
    explained = (
        isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str)
    )
    docstring = (first.end_lineno or first.lineno) - first.lineno + 1 if explained else 0
    return (function.end_lineno or function.lineno) - function.lineno + 1 - docstring


def test_nothing_reads_the_environment_at_import():
    wrong = []
    for path in FILES:
        for node in at_import(tree(path)):
            text = ast.unparse(node) if isinstance(node, ast.Attribute) else ""
            if text in ("os.environ", "os.getenv", "torch.manual_seed", "torch.cuda", "np.random", "torch.device"):
                wrong.append(f"{name(path)}:{node.lineno} {text}")
    assert not wrong


def at_import(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Everything that runs when a module is imported: all but bodies of functions and annotations."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns"):
            continue
        if field == "body" and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.expr | ast.stmt):
                yield child
            if isinstance(child, ast.AST):
                yield from at_import(child)


def dataclass_fields() -> Iterator[tuple[Path, str, str]]:
    """File, class and field of every configuration: dataclasses called ``...Config`` and all commands."""
    for path in FILES:
        for node in nodes(path):
            if not isinstance(node, ast.ClassDef) or not any(
                "dataclass" in ast.unparse(d) for d in node.decorator_list
            ):
                continue
            if node.name.endswith("Config") or room_of_file(path) == "cli":
                for statement in node.body:
                    if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
                        yield path, node.name, statement.target.id


def test_every_setting_is_read():
    read = {
        node.attr
        for path in FILES
        for node in nodes(path)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }
    assert not [f"{name(path)}: {owner}.{field}" for path, owner, field in dataclass_fields() if field not in read]


def test_a_wrong_shape_fails_under_the_hook(pytestconfig):
    """Without beartype in the option nothing is checked and every test would pass for the wrong reason."""
    if not pytestconfig.getoption("--jaxtyping-packages"):
        pytest.skip("needs --jaxtyping-packages=quest,beartype.beartype")
    import numpy as np
    from jaxtyping import TypeCheckError, config

    from quest.types import Camera

    config.update("jaxtyping_disable", False)  # as it is in tests that expect no errors
    with pytest.raises(TypeCheckError):
        Camera.from_opencv(np.eye(4), width=4, height=4)


if __name__ == "__main__":
    PICTURE.write_text(drawn(), encoding="utf-8")
