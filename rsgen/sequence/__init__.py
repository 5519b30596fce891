"""A sequence on disk: format, strict reader and trajectory files. Reading loads no writer and no renderer."""

from rsgen.sequence.reader import Sequence, Stream, read_sequence, sequence_info

__all__ = ["Sequence", "Stream", "read_sequence", "sequence_info"]
