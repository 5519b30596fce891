"""A look at a recording before it is tracked: what its depth is off by in every image, when its colours were taken, and
how much darker their corners are."""

from __future__ import annotations

from rsgen.console.progress import Progress
from rstrack.data.dataset import Dataset
from rstrack.options import Options


def wants_pattern(dataset: Dataset) -> bool:
    """Whether its depth may be off by a pattern that nothing states: a real camera, or one rendered like one."""
    return dataset.depth_error.pattern is None and bool(dataset.rig.sigma.depth_inverse_offset)


def looked_at(dataset: Dataset, chosen: range, options: Options, progress: Progress) -> Dataset:
    """The dataset with its depth's pattern, its colour stamps' offset, and what its colours lose towards their corners.

    Each is found from the chosen frames only where it is not known and matters to the method. Raises UserError.
    """
    wants_offset = dataset.timing is not None and dataset.timing.wants_color_offset
    wants_vignetting = dataset.rig.color_falloff is None
    wants_offset, wants_vignetting = options.photometric and wants_offset, options.photometric and wants_vignetting
    if not (wants_offset or wants_vignetting or wants_pattern(dataset)):
        return dataset
    # These import Dr.Jit.
    from rstrack.tracking.first_look.color_clock import estimate_color_offset
    from rstrack.tracking.first_look.depth_pattern import estimate_depth_pattern
    from rstrack.tracking.first_look.rough_track import GeometricTracks
    from rstrack.tracking.first_look.vignetting import estimate_vignetting

    tracks = GeometricTracks(dataset, chosen, options, progress)
    if wants_pattern(dataset):
        pattern = estimate_depth_pattern(dataset, tracks, progress)
        dataset = dataset.with_depth_pattern(pattern.pattern, pattern.text())
    if wants_offset:
        offset = estimate_color_offset(dataset, tracks, progress)
        dataset = dataset.with_color_offset(offset.offset_s, offset.text(), sigma_s=offset.sigma_in_all_s)
    if wants_vignetting:
        found = estimate_vignetting(dataset, tracks, progress)
        dataset = dataset.with_color_falloff(found.strength, found.text())
    return dataset
