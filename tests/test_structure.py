"""How the source code is built: functions of a page, a route of a page, contracts that are stated and not guessed."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "pipeline"
MODULES = sorted(PACKAGE.rglob("*.py"))
ROUTE = [path for path in MODULES if path.relative_to(PACKAGE).parts[0] in ("route.py", "method.py", "stages", "graph")]
MAX_FUNCTION_LINES = 60
MAX_ROUTE_LINES = 250
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def nodes(path: Path, *types: type[ast.AST]) -> Iterator[ast.AST]:
    return (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, types))


def names_in(node: ast.AST) -> set[str]:
    """Names and attributes below a node: ``{"isinstance", "Fuser"}``."""
    found = {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
    return found | {part.attr for part in ast.walk(node) if isinstance(part, ast.Attribute)}


@pytest.fixture(scope="module")
def protocols() -> set[str]:
    """Names of all classes of the package that are Protocols."""
    classes = [node for path in MODULES for node in nodes(path, ast.ClassDef)]
    return {cls.name for cls in classes if any("Protocol" in names_in(base) for base in cls.bases)}


def test_no_function_is_longer_than_a_page():
    lengths = {
        f"{path.relative_to(PACKAGE)}: {node.name}": node.end_lineno - node.lineno + 1
        for path in MODULES
        for node in nodes(path, *FUNCTIONS)
    }
    assert {name: lines for name, lines in lengths.items() if lines > MAX_FUNCTION_LINES} == {}


def test_the_route_is_a_page():
    assert len((PACKAGE / "route.py").read_text().splitlines()) <= MAX_ROUTE_LINES


def test_the_route_tells_variants_apart_by_their_contracts_and_not_by_their_method_names(protocols):
    for path in ROUTE:
        calls = [node for node in nodes(path, ast.Call) if "isinstance" in names_in(node.func)]
        asked = set().union(*(names_in(call.args[1]) for call in calls))
        assert not asked & protocols, path
        assert "runtime_checkable" not in path.read_text(), path
