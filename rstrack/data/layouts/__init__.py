"""The layouts of folders that can be tracked, found by what is in a folder.

To add a layout, write a module beside these and its line in LAYOUTS. The module has

    matches(root) -> bool                whether a folder has this layout
    read(root, camera_file) -> Dataset   what is in it; `dataset.recorded_dataset` makes one of listed images and stamps
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from rsgen.errors import UserError

LAYOUTS = {
    "an rsgen sequence (sequence.yaml)": "rstrack.data.layouts.generated",
    "a 7-Scenes folder (frame-000000.depth.png)": "rstrack.data.layouts.seven_scenes",
    "a TUM RGB-D or ICL-NUIM folder (rgb.txt and depth.txt, or associations.txt)": "rstrack.data.layouts.tum_folder",
}
"""Modules of the layouts, by what they are. The first that matches reads."""


def layout_of(root: Path) -> str:
    """The module for a folder. Raises UserError: it has none of the layouts."""
    found = next((name for name in LAYOUTS.values() if import_module(name).matches(root)), None)
    if found is None:
        raise UserError(f"{root}: has nothing that can be tracked: give {' or '.join(LAYOUTS)}")
    return found
