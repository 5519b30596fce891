"""Configs as files: what loads, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from rsgen.config.config import Config, load_config
from rsgen.errors import UserError

MINIMAL: dict[str, Any] = {"name": "demo", "trajectory": {"file": "t.txt"}, "scene": {"file": "s.xml"}}


def load(folder: Path, data: Any, overrides: dict[str, str] | None = None) -> Config:
    path = folder / "config.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return load_config(path, overrides)


def refused(folder: Path, data: Any, *parts: str, overrides: dict[str, str] | None = None) -> None:
    with pytest.raises(UserError) as error:
        load(folder, data, overrides)
    text = str(error.value)
    assert "\n" not in text and len(text) < 1000
    for part in parts:
        assert part in text, text
