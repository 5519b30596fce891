"""What is wrong with a frame, in words."""

from __future__ import annotations

from enum import StrEnum


class Fault(StrEnum):
    """Why a frame is lost; its text is what users read in `run.json` and on the screen."""

    NONE = ""
    NO_START = "the first frames have too little depth, or do not fit together"
    NOTHING_SEEN = "hardly a pixel falls on the keyframe"
    UNSETTLED = "the alignment does not converge"
    MISFIT = "an image does not fit the keyframe"
    MOTION = "the images do not agree with the motion"
    UNKNOWN = "the images do not determine the pose"
    # Of a frame that is looked for at the keyframes that look like it.
    NO_PLACE = "no keyframe shows what it shows"
    UNCONFIRMED = "it was found elsewhere, and the next frame has to confirm that"

    def __reduce_ex__(self, _: object) -> tuple[type[Fault], tuple[str]]:
        """By its text, for checkpoints: by its name it would be had through `getattr`, which they do not run."""
        return Fault, (self.value,)
