from .base import RGBDSequence, RGBDStream
from .cameras import load_camera
from .open_source import load_sequence, open_source
from .sequence_names import PAPER_SEQUENCES, canonical_name, short_name
from .sources import SourceOptions
from .tum import TUMSequence

__all__ = [
    "PAPER_SEQUENCES",
    "RGBDSequence",
    "RGBDStream",
    "SourceOptions",
    "TUMSequence",
    "canonical_name",
    "load_camera",
    "load_sequence",
    "open_source",
    "short_name",
]
