"""A recording with what a look at its first frames tells of its colours: when they were taken, how they fall off."""

from __future__ import annotations

from rsgen.console.progress import Progress
from rstrack.data.dataset import Dataset
from rstrack.options import Options


def looked_at(dataset: Dataset, chosen: range, options: Options, progress: Progress) -> Dataset:
    """The dataset with its colour stamps' offset, and with what its colour images lose towards their corners.

    Each is found from the chosen frames only where it is not known and matters to the method. Raises UserError.
    """
    if not options.photometric:
        return dataset
    if dataset.timing is not None and dataset.timing.wants_color_offset:
        from rstrack.tracking.first_look.color_offset import estimate_color_offset

        offset = estimate_color_offset(dataset, chosen, options, progress)
        dataset = dataset.with_color_offset(offset.offset_s, offset.text())
    if dataset.rig.color_falloff is None:
        from rstrack.tracking.first_look.color_falloff import estimate_color_falloff

        falloff = estimate_color_falloff(dataset, chosen, options, progress)
        dataset = dataset.with_color_falloff(falloff.falloff, falloff.text())
    return dataset
