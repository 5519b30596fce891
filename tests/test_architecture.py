"""The directions of imports, as the design document draws them, and what every file has to begin with."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from rsgen.config.config import load_config
from rsgen.formats import EXPORTS
from rsgen.sequence.trajectory import read_trajectory

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "rsgen").rglob("*.py"))
TRACKER = sorted((ROOT / "rstrack").rglob("*.py"))
BENCHMARKS = sorted((ROOT / "benchmarks").rglob("*.py"))
# What rstrack builds on; the rest of rsgen renders, or is about rendering.
SHARED = (
    "array_types", "console", "device", "errors", "figures", "files", "geometry", "image_codecs", "inputs", "limits",
    "sequence", "srgb",
)  # fmt: skip
ENGINES = ("mitsuba", "drjit")
WITHOUT_ENGINE = (
    "rsgen.geometry.so3", "rsgen.geometry.se3", "rsgen.geometry.spline", "rsgen.geometry.camera",
    "rsgen.geometry.shutter", "rsgen.sequence.reader", "rsgen.check.verify", "rsgen.config.config",
    "rsgen.sequence.trajectory", "rsgen.motion.fit", "rsgen.motion.statistics", "rsgen.device.backend",
    "rsgen.console.scheduler", "rsgen.produce.parts", "rsgen.produce.generate", "rsgen.produce.camera_sources",
    "rsgen.pictures.frames", "rsgen.cli.main", "rsgen.motion.make", "rsgen.sensors.color", "rsgen.sensors.depth",
    "rsgen.sensors.imu", "rsgen.config.sections", *{f"rsgen.formats.export.{export[0]}" for export in EXPORTS.values()},
)  # fmt: skip
CONFIGS = sorted(path for path in (ROOT / "configs").glob("*.yaml") if path.stem not in ("evaluation", "readout_sweep"))


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def parsed(path: Path) -> ast.Module:
    """A file's syntax tree: several tests look at the same."""
    return ast.parse(path.read_text())


@cache
def imports(path: Path) -> tuple[str, ...]:
    """Full names of all modules that a file imports, anywhere in it."""
    found = []
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            found += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return tuple(found)


def test_there_is_something_to_check() -> None:
    assert len(SOURCES) > 20 and ROOT / "rsgen/geometry/so3.py" in SOURCES and len(CONFIGS) >= 5
    assert len(TRACKER) > 20 and len(WITHOUT_ENGINE) > 30
    assert "numpy" in imports(ROOT / "rsgen/geometry/so3.py")


def test_no_engine_is_loaded_where_nothing_is_rendered() -> None:
    # One after the other in one process: the first that loads one is named.
    code = (
        "import importlib, sys\nfor name in sys.argv[1:]:\n    importlib.import_module(name)\n"
        f"    loaded = {set(ENGINES)!r} & set(sys.modules)\n    if loaded:\n        sys.exit(f'{{name}}: {{loaded}}')"
    )
    done = subprocess.run([sys.executable, "-c", code, *WITHOUT_ENGINE], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_help_and_info_load_no_engine_and_no_format() -> None:
    guests = (*ENGINES, "trimesh", "rosbags", "pxr", "rsgen.formats.")
    code = (
        "import sys\nfrom rsgen.cli.main import main\n"
        "for words in (['render', '--help'], ['export', '--help'], ['info', 'nowhere']):\n"
        "    try:\n        main(words)\n    except SystemExit:\n        pass\n"
        f"sys.exit(', '.join(name for name in sys.modules if name.startswith({guests!r})) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_tracker_loads_no_renderer() -> None:
    modules = [name(path).removesuffix(".py").replace("/", ".").removesuffix(".__init__") for path in TRACKER]
    assert "rstrack.cli.main" in modules and "rstrack.tracking.spline_tracker" in modules
    code = f"import sys, {', '.join(modules)}\nprint(*({{'mitsuba', 'trimesh'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == ""


def test_the_trackers_help_and_info_load_no_engine() -> None:
    code = (
        "import sys\nfrom rstrack.cli.main import main\nfor words in (['track', '--help'], ['info', 'nowhere']):\n"
        "    try:\n        main(words)\n    except SystemExit:\n        pass\n"
        f"sys.exit(bool({set(ENGINES)!r} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True).returncode == 0


def test_the_tracker_imports_only_what_is_shared() -> None:
    for path in TRACKER:
        for module in imports(path):
            package, _, rest = module.partition(".")
            assert package not in ("mitsuba", "tests", "scenes"), (name(path), module)
            assert package != "rsgen" or rest.split(".")[0] in SHARED or not rest, (name(path), module)


def test_no_modules_import_each_other_not_even_for_types() -> None:
    modules = {name(path).removesuffix(".py").replace("/", "."): path for path in (*SOURCES, *TRACKER, *BENCHMARKS)}
    modules = {module: path for module, path in modules.items() if not module.endswith("__init__")}
    graph = {module: set(imports(path)) & set(modules) - {module} for module, path in modules.items()}
    assert sum(map(len, graph.values())) > 1000
    tuple(TopologicalSorter(graph).static_order())  # raises CycleError, which names them


def test_geometry_imports_numpy_and_scipy_only() -> None:
    allowed = ("numpy", "scipy", "rsgen.array_types", "rsgen.errors", "rsgen.inputs", "rsgen.geometry")
    for path in (ROOT / "rsgen/geometry").glob("*.py"):
        for module in imports(path):
            known = module.split(".")[0] in sys.stdlib_module_names or module == "rsgen"
            assert known or any(module == a or module.startswith(f"{a}.") for a in allowed), (name(path), module)


def test_nothing_in_rsgen_imports_rstrack() -> None:
    for path in SOURCES:
        assert not any(module.split(".")[0] in ("rstrack", "tests", "scenes") for module in imports(path)), name(path)


def test_every_file_says_what_it_is_for() -> None:
    for path in {*SOURCES, *TRACKER, *BENCHMARKS, *(ROOT / "tests").glob("*.py"), *(ROOT / "scenes").rglob("*.py")}:
        text = ast.get_docstring(parsed(path))
        assert text is not None and len(text.splitlines()[0]) > 15, name(path)


def test_every_public_function_and_class_is_documented() -> None:
    for path in (*SOURCES, *TRACKER, *BENCHMARKS):
        for node in parsed(path).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                assert ast.get_docstring(node), f"{name(path)}: {node.name}"


def test_no_path_of_one_machine_is_in_the_project() -> None:
    here = [
        *SOURCES,
        *TRACKER,
        *BENCHMARKS,
        *CONFIGS,
        *(ROOT / "scenes").rglob("*.py"),
        *(ROOT / "tests").glob("*.py"),
        ROOT / "run.sh",
    ]
    forbidden = tuple(f"/{folder}/" for folder in ("work", "root", "home"))
    for path in here:
        found = [line for line in path.read_text().splitlines() if any(part in line for part in forbidden)]
        assert not found, f"{name(path)}: {found[0]}"


@pytest.mark.parametrize("path", CONFIGS, ids=name)
def test_every_config_is_valid(path: Path) -> None:
    config = load_config(path)
    assert config.name == path.stem
    assert config.scene.file.resolve().is_relative_to(ROOT)
    # ICL-NUIM's and TUM's trajectories are not part of the project.
    foreign = path.stem.startswith(("lr_kt", "wild", "twin"))
    if config.trajectory.file is not None and not foreign:
        assert len(read_trajectory(config.trajectory.file, format=config.trajectory.format)) > 10
