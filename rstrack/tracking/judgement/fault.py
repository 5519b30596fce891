"""What is wrong with a frame, in words."""

from __future__ import annotations

from enum import StrEnum


class Fault(StrEnum):
    """Why a frame is lost; its text is what users read in `run.json` and on the screen."""

    NONE = ""
    # Of images against the keyframe that the motion led to.
    NOTHING_SEEN = "hardly a pixel falls on the keyframe"
    UNSETTLED = "the alignment does not settle"
    LITTLE_DEPTH = "hardly a pixel of the depth image falls on the keyframe"
    LITTLE_COLOR = "hardly a pixel of the colour image falls on the keyframe"
    OTHER_DEPTH = "the depth image shows something else"
    OTHER_COLOR = "the colour image shows something else"
    ODD_DEPTH = "the depth image does not fit"
    ODD_COLOR = "the colour image does not fit"
    BOTH_ODD = "depth and colour both fit worse than they should"
    DOUBTFUL = "depth hardly tells a motion there, and fits worse than it should"
    UNSTEADY = "its lines do not show one motion, and no frames before tell it"
    DIVIDED = "depth and colour do not agree"
    PULLED = "the images do not agree with the motion"
    TOO_FAR = "it is further from where the motion led than a hand moves a camera"
    LEFT_OPEN = "what is seen leaves a motion open"
    DRAWS = "it draws frames before it from where they were found"
    # Of images against the keyframes that look like them, where the track is lost.
    NO_PLACE = "no keyframe shows what it shows"
    UNSURE = "only depth fits, which many places share"
    UNCONFIRMED = "it was found elsewhere, and the next frame has to confirm that"
    # At the start.
    NO_DEPTH = "hardly any depth to begin with"
    NO_START = "the first frames do not fit together"

    def __reduce_ex__(self, _: object) -> tuple[type[Fault], tuple[str]]:
        """By its text, for checkpoints: by its name it would be had through `getattr`, which they do not run."""
        return Fault, (self.value,)

    @property
    def is_elsewhere(self) -> bool:
        """Whether the keyframe is not in view where the motion led."""
        return self in (Fault.NOTHING_SEEN, Fault.LITTLE_DEPTH, Fault.LITTLE_COLOR)

    @property
    def is_pull(self) -> bool:
        """Whether images were found where the motion led, but pull away from it."""
        return self in (Fault.DIVIDED, Fault.PULLED, Fault.DRAWS)
