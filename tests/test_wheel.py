"""The wheel carries all that the demo needs, can be built again byte for byte, and finds its configs by name.

What messages and documents say of installing is so.
"""

from __future__ import annotations

import ast
import hashlib
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import PathDistribution
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

from rsgen.config.config import load_config
from rsgen.console.configs import config_file, configs_folder
from rsgen.errors import how_to_install

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Packages whose modules have another name, and what comes with a package that is named.
PACKAGES = {
    "PIL": "pillow", "cv2": "opencv-python-headless", "skimage": "scikit-image", "yaml": "PyYAML", "rerun": "rerun-sdk",
    "bpy": "bpy", "mathutils": "bpy", "pxr": "usd-core", "liblzfse": "pyliblzfse", "dask": "distributed",
    "apsw": "rosbags", "lz4": "rosbags", "markupsafe": "jinja2", "ncore": "nvidia-ncore",
    "Datasets": "VSLAM-LAB", "Baselines": "VSLAM-LAB",
}  # fmt: skip


def build(source: Path, out: Path) -> tuple[Path, Path]:
    """The sdist and the wheel of a source tree, as docs/releasing.md builds them."""
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(out), "-t", "sdist", "-t", "wheel"]
    environment = os.environ | {"SOURCE_DATE_EPOCH": "1700000000"}
    done = subprocess.run(command, cwd=source, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return next(out.glob("*.tar.gz")), next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The sdist and the wheel of this checkout."""
    if find_spec("hatchling") is None:
        pytest.skip("hatchling, which builds the wheel, is not installed")
    return build(ROOT, tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def site(dist: tuple[Path, Path]) -> Path:
    """The wheel's files, unpacked as pip does, in folders that nobody should write into."""
    out = dist[1].parent / "site"
    with zipfile.ZipFile(dist[1]) as wheel:
        wheel.extractall(out)
    return out


def run(site: Path, place: Path, *words: str) -> str:
    """Output of Python in an empty folder with this wheel, and a user's cache of its own."""
    environment = os.environ | {"PYTHONPATH": str(site), "XDG_CACHE_HOME": str(place / "cache")}
    done = subprocess.run([sys.executable, *words], cwd=place, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def names(folder: Path, ending: str) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob(f"*.{ending}"))


def test_the_wheel_has_all_configs_and_scripts_and_nothing_built(site: Path) -> None:
    for folder, ending in (("configs", "yaml"), ("configs", "txt"), ("scenes", "py")):
        assert names(site / "rsgen/share" / folder, ending) == names(ROOT / folder, ending) != []
    assert {path.name for path in site.iterdir() if "dist-info" not in path.name} == {"rsgen", "rstrack"}
    assert not [path for path in site.rglob("*") if path.suffix in (".xml", ".ply", ".npz")]
    assert (site / "rstrack/report/page.html").is_file()
    assert (site / "rsgen/py.typed").is_file() and (site / "rstrack/py.typed").is_file()


def test_a_build_elsewhere_has_the_same_bytes(dist: tuple[Path, Path], tmp_path: Path) -> None:
    """Of the unpacked sdist, whose files are in another place, younger and their owner's alone."""
    with tarfile.open(dist[0]) as archive:
        archive.extractall(tmp_path)  # our own
    source = next(tmp_path.iterdir())
    (source / "PKG-INFO").unlink()  # written into an sdist; one that is there would be packed beside the new one
    for path in source.rglob("*"):
        path.chmod(path.stat().st_mode & 0o700)
        os.utime(path)
    again = build(source, tmp_path)
    assert [hashlib.sha256(path.read_bytes()).hexdigest() for path in again] == [
        hashlib.sha256(path.read_bytes()).hexdigest() for path in dist
    ]


def test_configs_of_the_wheel_are_found_by_name_and_kept_in_the_users_cache(site: Path, tmp_path: Path) -> None:
    before = sorted(path for path in site.rglob("*") if "__pycache__" not in path.parts)
    listed = run(site, tmp_path, "-m", "rsgen", "scenes")
    found = {line.split()[0] for line in listed.splitlines() if line.startswith("    ")}
    of_sequences = {name.removesuffix(".yaml") for name in names(configs_folder(), "yaml") if "/" not in name}
    assert found == of_sequences - {"evaluation", "readout_sweep"}
    code = (
        "from rsgen.config.config import load_config; from rsgen.console.configs import config_file\n"
        "print(load_config(config_file('demo')).scene.file.parent.resolve())"
    )
    scene = Path(run(site, tmp_path, "-c", code).strip())
    assert (scene / "build.py").is_file() and scene.is_relative_to(tmp_path / "cache" / "rsgen")
    assert "table1" in run(site, tmp_path, "-m", "rsgen", "motion", "stats", "table1")
    assert before == sorted(path for path in site.rglob("*") if "__pycache__" not in path.parts)


def test_in_a_checkout_configs_are_used_where_they_are() -> None:
    assert config_file("demo") == ROOT / "configs/demo.yaml"
    assert load_config(config_file("demo")).scene.file.resolve() == ROOT / "scenes/living_room/scene.xml"


def test_a_file_goes_before_a_name_and_another_name_is_taken_for_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "table1").mkdir()
    (tmp_path / "demo").write_text("name: mine")
    assert config_file("demo") == Path("demo") and config_file("none") == Path("none")
    assert config_file("table1") == ROOT / "configs/table1.yaml"  # a folder is no config


def requirement(text: str) -> str:
    return re.split(r"[^\w.-]", text)[0].lower()


def modules(path: Path) -> set[str]:
    """Packages that a file imports, by statement or by `import_module` of a constant."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            found |= {str(node.args[0].value)} if name == "import_module" else set()
    return {name.partition(".")[0] for name in found} - sys.stdlib_module_names - {"rsgen", "rstrack", ""}


def test_all_that_is_imported_is_required_or_an_extra() -> None:
    extras = {name: parts for name, parts in PROJECT["optional-dependencies"].items() if name not in ("test", "docs")}
    known = {requirement(text) for text in (*PROJECT["dependencies"], *(part for e in extras.values() for part in e))}
    files = [path for folder in ("rsgen", "rstrack", "docs/examples") for path in (ROOT / folder).rglob("*.py")]
    used = {name for path in files for name in modules(path)}
    known.add("vslam-lab")  # whose own modules are beside the examples for it
    assert {"rosbags", "pyrealsense2", "pxr"} < used
    assert not {name for name in used if PACKAGES.get(name, name).lower() not in known}


def test_the_wheel_offers_the_extras_that_are_named(site: Path) -> None:
    found = PathDistribution(next(site.glob("*.dist-info"))).metadata
    extras = set(found.get_all("Provides-Extra") or ())
    assert extras == set(PROJECT["optional-dependencies"])
    texts = [
        ROOT / "README.md",
        *(ROOT / "docs").rglob("*.md"),
        *(p for f in ("rsgen", "rstrack", "docs") for p in (ROOT / f).rglob("*.py")),
    ]
    told = "\n".join(path.read_text() for path in texts if path.name != "releasing.md")
    named = {name for group in re.findall(r"'\.\[([\w,]+)\]'", told) for name in group.split(",")}
    assert len(named) > 5 and named <= extras
    assert "install rolling-shutter-rgbd" not in told and "rgbd[" not in told  # no registry has it
    assert found["Version"] == PROJECT["version"]


def test_messages_name_the_packages_of_the_extras() -> None:
    assert how_to_install("ros") == "pip install 'rosbags<0.12,>=0.11.9'"
    assert how_to_install("peers", package="small-gicp") == "pip install 'small-gicp<2,>=1'"
    both = how_to_install("peers", "orbslam3")
    assert "pyorbslam3" in both and "open3d" in both and "rosbags" not in both
    with pytest.raises(ValueError, match="no package 'rosbags' in the extras peers"):
        how_to_install("peers", package="rosbags")
    code = "\n".join(path.read_text() for folder in ("rsgen", "rstrack") for path in (ROOT / folder).rglob("*.py"))
    calls = re.findall(r"""how_to_install\((['"]\w+['"][^)]*)\)""", code)
    assert len(calls) > 10
    for call in calls:
        names = re.findall(r"""(?<!=)['"]([\w-]+)['"]""", call)
        package = re.search(r"package=['\"]([\w-]+)", call)
        assert how_to_install(*names, package=package[1] if package else "").startswith("pip install '")


def test_what_is_to_be_cited_is_this_version() -> None:
    cited = yaml.safe_load((ROOT / "docs/CITATION.cff").read_text())
    assert cited["cff-version"] == "1.2.0" and {"message", "title", "authors"} <= set(cited)
    assert cited["version"] == PROJECT["version"] and cited["license"] == PROJECT["license"]
    told = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", (ROOT / "docs/CHANGELOG.md").read_text(), re.M)
    assert told[0] == (PROJECT["version"], str(cited["date-released"]))
    numbers = [tuple(map(int, version.split("."))) for version, _ in told]
    assert numbers == sorted(set(numbers), reverse=True) and numbers[-1] == (0, 1, 0)
