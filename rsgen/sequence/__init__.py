"""A sequence on disk: format, strict reader and trajectory files. Reading loads no writer and no renderer."""

from rsgen.sequence.images import ImageStream, Sequence
from rsgen.sequence.reader import read_sequence, sequence_info

__all__ = ["ImageStream", "Sequence", "read_sequence", "sequence_info"]
