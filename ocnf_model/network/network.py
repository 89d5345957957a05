"""OctNetFusion: a coarse-to-fine encoder-decoder on grid-octrees (paper section 3.3, SEMANTICS 5)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import nn

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_model.devices import Precision
from ocnf_model.network.choices import Carry, Join, Normaliser, Output, Widths, choice, widths_at
from ocnf_model.network.finer import GAIN, guessed_encoding, pooled_encoding
from ocnf_model.network.level import Level, LevelOutput
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.ops import FusionBlend, concat, split_surface


class OctNetFusion(nn.Module):
    """Encoded views at several resolutions, coarse to fine, to a reconstruction at each.

    Level l takes the encoding at its resolution and, from the second on, what the level before carries up:
    split near its reconstructed surface and put side by side with the encoding. Input channels of a level,
    with the histogram's 10 and channels[0] = 16: 10 for the first; 26 for later ones carrying features, 11
    carrying the reconstruction; 10 more for each of the first `finer` ones. Parameters of all, TSDF: see
    `Level`, or `ocnf-model info RUN`; with the defaults 606,113 for the first and 613,025 for each later
    level, 1,832,163 in all.

    >>> inputs = [OctreeBatch.full(torch.zeros(2, 10, side, side, side)) for side in (32, 64)]
    >>> network = OctNetFusion(levels=2, channels=(2, 4, 8))
    >>> coarse, fine = network(inputs)                       # TSDF / tau, each on its own structure
    >>> coarse.to_dense().shape, fine.to_dense().shape
    (torch.Size([2, 1, 32, 32, 32]), torch.Size([2, 1, 64, 64, 64]))

    Args:
        encoding: encoding of the inputs, an `Encoding`.
        levels: number of levels, 1 or more; each doubles the resolution.
        join: `concat` (the paper) or `add`.
        carry: `features` (the paper) or `reconstruction`.
        output: `tsdf` or `occupancy`.
        channels: numbers of channels at the three resolutions within a level; they set the network's size.
        band: how far from the surface `split_surface` splits, in fine voxels.
        context: width of the first level's `DenseContext`, which looks at the whole volume; 0 for none (the
            paper). Later levels get what it finds with the features that are carried up.
        residual: whether convolutions that keep the number of channels add to their input; the paper's do
            not.
        normalise: `none` (the paper) or `batch`, which trains faster; it goes together with checkpointing no
            more than any layer that remembers what passed through it.
        blend: whether every level blends its TSDF with that of plain fusion (`FusionBlend`); the paper's
            does not.
        finer: how many levels, from the first on, also read the encoding of the next resolution, the mean of
            eight voxels: one pixel a view and voxel is little where a voxel covers many. 0 in the paper.
            Where the inputs end before it, it is guessed from their last one, which costs most of the gain.
        checkpointing: keep fewer activations for the backward pass, and compute them again.
        extra_channels: channels that every input has behind the encoding's, 0 or more.
        level_channels: those of the first few levels, where they differ: the first level costs the least, and
            what it believes the later ones inherit. None for `channels` everywhere (the paper).

    Attributes:
        precision: what `evaluate`, `fuse` and the like let it compute in, where the device is fast in that:
            what a run was trained in, else float32. Calling it is not affected.

    Raises:
        OcnfError: a setting outside its range.
    """

    def __init__(
        self, encoding: str = Encoding.HISTOGRAM, levels: int = 3, join: str = Join.CONCAT,
        carry: str = Carry.FEATURES, output: str = Output.TSDF, channels: Sequence[int] = (16, 32, 64),
        band: float = 1, context: int = 0, residual: bool = False, normalise: str = Normaliser.NONE,
        blend: bool = False, finer: int = 0, checkpointing: bool = False, extra_channels: int = 0,
        level_channels: Sequence[Sequence[int]] | None = None,
    ) -> None:
        super().__init__()
        self.encoding = choice(Encoding, "encoding", encoding)
        self.join, self.carry = choice(Join, "join", join), choice(Carry, "carry", carry)
        self.output = choice(Output, "output", output)
        for field, number, least in (("levels", levels, 1), ("context", context, 0), ("finer", finer, 0),
                                     ("extra_channels", extra_channels, 0)):
            if not isinstance(number, int) or isinstance(number, bool) or number < least:
                raise OcnfError("out of range", where="OctNetFusion", field=field, found=number,
                                expected=f"a whole number, at least {least}")
        if not (isinstance(band, float | int) and 0 <= band < math.inf):
            raise OcnfError("out of range", where="OctNetFusion", field="band", found=band,
                            expected="0 or more")
        self.channels = _widths("channels", channels)
        if level_channels is not None and not (isinstance(level_channels, Sequence) and level_channels):
            raise OcnfError("no channels", where="OctNetFusion", field="level_channels", found=level_channels,
                            expected="three positive numbers for at least one level")
        self.level_channels = None if level_channels is None else tuple(
            _widths("level_channels", channels) for channels in level_channels)
        self.band, self.context, self.residual = band, context, residual
        self.normalise = choice(Normaliser, "normalise", normalise)
        self.precision = Precision.FLOAT32
        self.blend, self.finer, self.extra_channels = blend, finer, extra_channels
        if blend and self.output is Output.OCCUPANCY:
            raise OcnfError("only a TSDF can be blended with that of plain fusion", where="OctNetFusion",
                            field="blend", found=blend, expected="false, or output: tsdf")
        self.in_channels = self.encoding.channels + extra_channels
        self.levels = nn.ModuleList()
        column = 0  # of the first channel of the encoding, behind what the level before carries up
        for level in range(levels):
            widths = self.widths(level)
            read = column + (2 if level < finer else 1) * self.in_channels
            made = Level(
                read, widths, self.join, self.output, 0 if level else context, residual,
                self.normalise, FusionBlend(self.encoding, column, widths[0]) if blend else None)
            weight = made.state_dict()["first.0.weight"]
            if level < finer and not weight.is_meta:  # new ones are He's for what is read without the gain
                weight[:, column + self.in_channels:] /= GAIN
            self.levels.append(made)
            column = widths[0] if self.carry is Carry.FEATURES else 1
        self.set_checkpointing(checkpointing)

    def widths(self, level: int) -> Widths:
        """The channels of a level (from 0) at the three resolutions within it."""
        return widths_at(level, self.channels, self.level_channels)

    def forward(self, inputs: Sequence[OctreeBatch]) -> list[OctreeBatch]:
        """The reconstruction of each level, TSDF / tau or probability of occupancy, on its own structure.

        Args:
            inputs: encodings, coarse to fine, each twice the resolution of the one before, shapes multiples
                of 32 voxels; for all levels, or for the first few of them (`needs`).

        Raises:
            OcnfError: the inputs do not fit the network or each other.
        """
        return [result.reconstruction for result in self.run(inputs)]

    def run(self, inputs: Sequence[OctreeBatch], frozen: int = 0, levels: int | None = None,
            ) -> list[LevelOutput]:
        """The forward pass, with all that each level makes.

        Args:
            inputs: encoded views, an `OctreeBatch` for each level, coarse to fine.
            frozen: levels before this one run without gradients: to train level l (from 0) alone, pass
                `frozen=l` and `levels=l + 1` and take the last output.
            levels: how many levels run; None: one for each input, all at most.

        Raises:
            OcnfError: the inputs do not fit the network or each other, or there are not so many levels or
                inputs.
        """
        self._check(inputs)
        most = min(len(inputs), len(self.levels))
        if levels is not None and not 0 < levels <= most:
            raise OcnfError("no such number of levels", where="OctNetFusion", field="levels", found=levels,
                            expected=f"1 to {most}, as there are levels and inputs")
        outputs: list[LevelOutput] = []
        for level in range(most if levels is None else levels):
            with torch.set_grad_enabled(torch.is_grad_enabled() and level >= frozen):
                x = self.level_input(outputs[-1] if outputs else None, inputs, level)
                outputs.append(self.levels[level](x))
        return outputs

    def needs(self, levels: int) -> int:
        """How many inputs the first `levels` levels read."""
        return levels + (1 if 0 < levels <= self.finer else 0)

    def reads(self, resolutions: Sequence[int]) -> list[int]:
        """Resolutions of the inputs that levels of these resolutions read, coarse to fine."""
        return [resolutions[0] << i for i in range(self.needs(len(resolutions)))]

    def check_plain(self, where: object) -> None:
        """Raise OcnfError where it reads more than an encoding, as networks of completion do."""
        if self.extra_channels:
            raise OcnfError("the network is one of completion, for single views of tabletops", where=where,
                            field="extra_channels", found=self.extra_channels, expected=0,
                            fix="use it with `ocnf-model complete`")

    def level_input(self, before: LevelOutput | None, inputs: Sequence[OctreeBatch],
                    level: int) -> OctreeBatch:
        """What a level (from 0) reads, side by side.

        What the level before carries up, if there is one; the encoding; and for the first `finer` levels that
        of the next resolution, pooled, or guessed where the inputs end; on a structure that is at least as
        fine as each of the three.
        """
        encoded = inputs[level]
        finer = None
        if level < self.finer:
            known = level + 1 < len(inputs)
            finer = pooled_encoding(inputs[level + 1]) if known else guessed_encoding(encoded, self.encoding)
        structure = encoded.structure if finer is None else encoded.structure.union(finer.structure)
        if before is None:
            x = encoded.refined(structure)
        else:
            reconstruction = before.reconstruction
            carried = before.features if self.carry is Carry.FEATURES else \
                reconstruction.to(dtype=before.raw.features.dtype)  # as short as the weights are
            x = split_surface(carried, reconstruction, self.band, guide=structure,
                              threshold=self.output.threshold)
            x = concat(x, encoded.to(dtype=x.features.dtype))  # autocast makes the carried ones short
        return x if finer is None else concat(x, finer.to(dtype=x.features.dtype))

    def start_from_previous(self, level: int) -> list[str]:
        """Copy to a level (from 1) the weights of the one before.

        Returns:
            Names of the weights that stay as they were: the first layer's, which reads other channels, and
            those of layers that do not have all of the same shapes.

        Raises:
            OcnfError: there is no such level, or none before it.
        """
        if not 0 < level < len(self.levels):
            raise OcnfError("no level before this one", where="OctNetFusion", field="level", found=level,
                            expected=f"1 to {len(self.levels) - 1}")
        before, own = self.levels[level - 1].state_dict(), self.levels[level].state_dict()
        others = {_layer(name) for name in own
                  if name not in before or before[name].shape != own[name].shape}
        fitting = {name: before[name] for name in own if _layer(name) not in others}
        self.levels[level].load_state_dict(fitting, strict=False)
        return [name for name in own if name not in fitting]

    def set_checkpointing(self, on: bool) -> None:
        """Whether the backward pass computes the activations within a block again, to keep fewer.

        Raises:
            OcnfError: it is switched on for a network with batch normalisation.
        """
        if on and self.normalise is Normaliser.BATCH:
            raise OcnfError("batch normalisation would count every batch twice", where="OctNetFusion",
                            field="checkpointing", found=True, expected="false, or normalise: none")
        for module in self.modules():
            if isinstance(module, Level):
                module.checkpointing = on

    def _check(self, inputs: Sequence[OctreeBatch]) -> None:
        most = self.needs(len(self.levels))
        if not isinstance(inputs, Sequence) or not all(isinstance(one, OctreeBatch) for one in inputs):
            raise OcnfError("not a sequence of octrees", where="OctNetFusion", field="inputs",
                            found=type(inputs).__name__, expected=f"1 to {most} OctreeBatch, coarse to fine")
        if not 0 < len(inputs) <= most:
            raise OcnfError("a wrong number of inputs", where="OctNetFusion", field="inputs",
                            found=len(inputs), expected=f"1 to {most}, coarse to fine")
        for level, encoded in enumerate(inputs):
            field = f"inputs[{level}]"
            if encoded.channels != self.in_channels:
                extra = f" and {self.extra_channels} more" if self.extra_channels else ""
                raise OcnfError("wrong channels", where="OctNetFusion", field=field, found=encoded.channels,
                                expected=f"{self.in_channels} for {self.encoding}{extra}")
            size = tuple(n << level for n in inputs[0].shape)
            if encoded.shape != size or encoded.batch_size != inputs[0].batch_size:
                raise OcnfError("sizes do not fit", where="OctNetFusion", field=field,
                                found=encoded.structure.describe(),
                                expected=f"{inputs[0].batch_size} of {'x'.join(map(str, size))}")
        if any(n % 32 for n in inputs[0].shape):
            raise OcnfError("two poolings need shapes that are multiples of 32", where="OctNetFusion",
                            field="inputs[0]", found=inputs[0].structure.describe())


def _layer(name: str) -> str:
    """What is taken over as a whole: `down1.0` for `down1.0.weight`, `head` for `head.weight`."""
    parts = name.split(".")
    if name.startswith("first."):  # its bias fits where its weight reads other channels
        return name
    return ".".join(parts[:2]) if len(parts) > 2 else parts[0]


def _widths(field: str, channels: Sequence[int]) -> Widths:
    whole = isinstance(channels, Sequence) and not isinstance(channels, str) and all(
        isinstance(n, int) and not isinstance(n, bool) for n in channels)
    if not whole or len(channels) != 3 or min(channels) < 1:
        raise OcnfError("not channels", where="OctNetFusion", field=field, found=channels,
                        expected="three positive numbers")
    return channels[0], channels[1], channels[2]
