"""The arrows between the parts of the package, and what must not be imported."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import rtc_cli
from rtc_cli.cli.app import COMMANDS

PACKAGE = Path(rtc_cli.__file__).parent

LEAVES = {
    "errors",
    "units",
    "files",
    "intervals",
    "levels",
    "autocorrelation",
    "fixed_costs",
    "traces",
}

ARROWS = {
    "__main__": {"cli"},
    "cli": {"pipeline", "analysis", "report", "tasks"},
    "pipeline": {"experts", "data", "training", "execution", "analysis"},
    "analysis": {"execution"},
    "execution": {"samplers", "tasks", "core"},
    "training": {"data", "core"},
    "data": {"tasks"},
    "experts": {"tasks", "core"},
    "gym": {"tasks"},
    "samplers": {"core"},
    "report": {"results", "intervals", "execution.timeline", "runs", "recipe"},
    "core": set(),
    "tasks": set(),
    "recipe": set(),
    "runs": {"recipe"},
    "results": set(),
    "runtime": set(),
    "errors": set(),
    "units": {"errors"},
    "files": {"errors"},
    "intervals": {"errors"},
    "levels": {"errors"},
    "autocorrelation": set(),
    "fixed_costs": {"errors"},
    "traces": {"autocorrelation", "errors", "files", "fixed_costs", "units"},
}

# Beside the arrows: the types of a recipe's sections, the run's layout, the records of results.
CONFIGURED = {"experts", "data", "training", "execution", "analysis", "pipeline", "report", "cli"}
RECORDED = {"execution", "analysis", "pipeline", "cli", "training"}
HEAVY = ("jax", "jaxlib", "flax", "optax", "orbax", "pymunk", "matplotlib", "pandas", "pyarrow")


def closure(part: str) -> set[str]:
    """What a part may import: along the arrows as far as they lead."""
    found: set[str] = set()
    waiting = [part]
    while waiting:
        for target in ARROWS.get(waiting.pop(), set()) - found:
            found.add(target)
            waiting.append(target)
    return found


def part_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def imports_of(file: Path) -> set[str]:
    """Full names of all modules a file imports, also inside functions and for type checking."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            base = node.module or ""
            found.add(base)
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return found


FILES = sorted(file for file in PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(PACKAGE).as_posix())
def test_arrows(file):
    relative = file.relative_to(PACKAGE).with_suffix("")
    part = relative.parts[0]
    if part == "__init__":
        return
    allowed = closure(part) | {part, "__version__", ""}
    if part not in LEAVES:
        allowed |= LEAVES
    if part in CONFIGURED:
        allowed |= {"recipe", "runs"}
    if part in RECORDED:
        allowed |= {"results"}
    if part in ("cli", "pipeline"):
        allowed.add("runtime")
    for module in imports_of(file):
        if module.split(".")[0] != "rtc_cli":
            continue
        target = part_of(module)
        if target == "execution" and "execution" not in allowed:
            inner = ".".join(module.split(".")[1:3])
            assert inner in allowed | {"execution"}, f"{relative} imports {module}"
            continue
        assert target in allowed, f"{relative} imports {module}: not along the arrows of {part}"


@pytest.mark.parametrize(
    ("part", "forbidden"),
    [
        ("tasks", {"jax", "jaxlib", "flax"}),
        ("gym", {"jax", "jaxlib", "flax"}),
        ("report", {"jax", "jaxlib", "flax", "pymunk"}),
        ("core", {"pymunk", "pandas", "matplotlib"}),
        ("samplers", {"pymunk", "pandas", "matplotlib"}),
    ],
)
def test_forbidden_libraries(part, forbidden):
    for file in (PACKAGE / part).rglob("*.py"):
        used = {module.split(".")[0] for module in imports_of(file)}
        assert not used & forbidden, file


def loaded_by(code: str) -> set[str]:
    """Top-level packages that are loaded after running the code in a fresh process."""
    show = "import sys; print(*{name.split('.')[0] for name in sys.modules}, file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{show}"], capture_output=True, text=True, check=True
    )
    return set(done.stderr.split())


@pytest.mark.parametrize("args", [["--help"], ["--version"]])
def test_the_front_door_loads_nothing_heavy(args):
    loaded = loaded_by(f"from rtc_cli.cli.app import run; run({args!r})")
    assert not loaded & {*HEAVY, "numpy", "pydantic", "rich", "scipy"}


def test_no_command_loads_anything_heavy_for_its_help_page():
    code = "from rtc_cli.cli.app import run"
    for name in COMMANDS:
        code += f"\nassert run([{name!r}, '--help']) == 0"
    assert not loaded_by(code) & set(HEAVY)


def test_the_analysis_of_latencies_loads_no_jax():
    code = "import rtc_cli.analysis.findings, rtc_cli.traces, rtc_cli.report.latency.page"
    assert not loaded_by(code) & {"jax", "jaxlib", "pymunk", "matplotlib"}
    assert not loaded_by("import rtc_cli.traces") & set(HEAVY)


def test_tasks_and_report_load_no_jax():
    code = "import rtc_cli.tasks, rtc_cli.tasks.batch, rtc_cli.report.page, rtc_cli.report.tables"
    assert not loaded_by(code) & {"jax", "jaxlib"}
