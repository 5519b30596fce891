"""A recording with what a look at its first frames tells of its colours: when they were taken, how they fall off."""

from __future__ import annotations

from rsgen.console.progress import Progress
from rstrack.data.dataset import Dataset
from rstrack.options import Options


def looked_at(dataset: Dataset, chosen: range, options: Options, progress: Progress) -> Dataset:
    """The dataset with its colour stamps' offset, and with what its colour images lose towards their corners.

    Each is found from the chosen frames only where it is not known and matters to the method. Raises UserError.
    """
    wants_offset = dataset.timing is not None and dataset.timing.wants_color_offset
    wants_falloff = dataset.rig.color_falloff is None
    if not options.photometric or not (wants_offset or wants_falloff):
        return dataset
    from rstrack.tracking.first_look import color_falloff, color_offset
    from rstrack.tracking.first_look.color_pairs import GeometricTracks

    tracks = GeometricTracks(dataset, chosen, options, progress)
    if wants_offset:
        offset = color_offset.estimate_color_offset(dataset, tracks, progress)
        dataset = dataset.with_color_offset(offset.offset_s, offset.text(), sigma_s=offset.sigma_in_all_s)
    if wants_falloff:
        falloff = color_falloff.estimate_color_falloff(dataset, tracks, progress)
        dataset = dataset.with_color_falloff(falloff.falloff, falloff.text())
    return dataset
