"""The network: levels of an encoder-decoder on grid-octrees, coarse to fine (SEMANTICS 5)."""

from ocnf_model.network.choices import Carry, Join, Normaliser, Output, Widths, widths_at
from ocnf_model.network.level import Level, LevelOutput
from ocnf_model.network.network import OctNetFusion
from ocnf_model.network.normalise import fold_normalisation, freeze_statistics
from ocnf_model.network.widen import reading_wider, widened

__all__ = ["Carry", "Join", "Level", "LevelOutput", "Normaliser", "OctNetFusion", "Output", "Widths",
           "fold_normalisation", "freeze_statistics", "reading_wider", "widened", "widths_at"]
