"""What the network is measured against: VolFus, and TV-L1 with a weight chosen by cross-validation."""

from ocnf_model.baselines.crossval import WeightChoice, choose_weight
from ocnf_model.baselines.total_variation import Solution, minimise, tvl1
from ocnf_model.baselines.volumetric import volfus_from_encoding

__all__ = ["Solution", "WeightChoice", "choose_weight", "minimise", "tvl1", "volfus_from_encoding"]
