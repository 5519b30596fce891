"""A look at a recording before it is tracked: when its colours were taken, and how much darker their corners are."""

from __future__ import annotations

from rsgen.console.progress import Progress
from rstrack.data.dataset import Dataset
from rstrack.options import Options


def looked_at(dataset: Dataset, chosen: range, options: Options, progress: Progress) -> Dataset:
    """The dataset with its colour stamps' offset, and with what its colour images lose towards their corners.

    Each is found from the chosen frames only where it is not known and matters to the method. Raises UserError.
    """
    wants_offset = dataset.timing is not None and dataset.timing.wants_color_offset
    wants_vignetting = dataset.rig.color_falloff is None
    if not options.photometric or not (wants_offset or wants_vignetting):
        return dataset
    # These import Dr.Jit.
    from rstrack.tracking.first_look.color_clock import estimate_color_offset
    from rstrack.tracking.first_look.rough_track import GeometricTracks
    from rstrack.tracking.first_look.vignetting import estimate_vignetting

    tracks = GeometricTracks(dataset, chosen, options, progress)
    if wants_offset:
        offset = estimate_color_offset(dataset, tracks, progress)
        dataset = dataset.with_color_offset(offset.offset_s, offset.text(), sigma_s=offset.sigma_in_all_s)
    if wants_vignetting:
        found = estimate_vignetting(dataset, tracks, progress)
        dataset = dataset.with_color_falloff(found.strength, found.text())
    return dataset
