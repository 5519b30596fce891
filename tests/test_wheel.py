"""The wheel carries all that the demo needs, and its configs are found by name wherever it is installed."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from rsgen.config.config import load_config
from rsgen.console.configs import config_file, configs_folder

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel's files, unpacked as pip does, in folders that nobody should write into."""
    if find_spec("hatchling") is None:
        pytest.skip("hatchling, which builds the wheel, is not installed")
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet", "-w", out, ROOT]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(next(out.glob("*.whl"))) as wheel:
        wheel.extractall(out / "site")
    return out / "site"


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


def test_configs_of_the_wheel_are_found_by_name_and_kept_in_the_users_cache(site: Path, tmp_path: Path) -> None:
    before = sorted(path for path in site.rglob("*") if "__pycache__" not in path.parts)
    listed = run(site, tmp_path, "-m", "rsgen", "configs")
    configs = names(configs_folder(), "yaml")
    assert [line.split()[0] for line in listed.splitlines()[:-1]] == [name.removesuffix(".yaml") for name in configs]
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
