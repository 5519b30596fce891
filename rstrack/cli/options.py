"""Arguments that several `rstrack` commands share."""

from pathlib import Path
from typing import Annotated

SequenceFolder = Annotated[Path, "rsgen sequence, TUM RGB-D or ICL-NUIM folder"]
CameraFile = Annotated[Path | None, "cameras of a TUM or ICL-NUIM folder (default: one inside it)", "FILE"]
Run = Annotated[Path, "folder that 'rstrack track' wrote, or a TUM file"]
