"""A manifest's samples by number: bodies and looks drawn, ground truth and input made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ocnf_data.loading.catalogue import Request
from ocnf_data.loading.fetch import RawSample
from ocnf_data.octree.stored import RawOctree
from ocnf_data.shards.tarformat import input_member, target_member
from ocnf_data.synthesis.draw import Body, Look, draw_body, draw_look, season_of
from ocnf_data.synthesis.sample import make_inputs, make_truths, pose
from ocnf_data.synthesis.scenes import PlacedScene
from ocnf_data.synthesis.sources import Sources
from ocnf_data.synthesis.truths import TruthCache
from ocnf_data.views.noise import NoiseModel

DRAWN_VARIANT = "synthesis"
"""What stands in a synthetic input's member name for the variant's."""


class SynthesisSupply:
    """Samples drawn from a manifest; see `loading.supply.Supply`.

    Args:
        sources: what samples are made of.
        request: what is wanted of every sample.
        seed: seed of everything that is drawn.
        cache: folder of the ground truths that epochs share, or None.
    """

    def __init__(self, sources: Sources, request: Request, seed: int, cache: Path | None) -> None:
        self.request = request
        self._sources, self._seed = sources, seed
        self._repeat = sources.settings.repeat
        self._cache = None if cache is None or self._repeat == 1 else TruthCache(cache, sources.checksum)

    @property
    def checksum(self) -> str:
        """The checksum of the sources."""
        return self._sources.checksum

    @property
    def order(self) -> list[Any]:
        """The seed."""
        return [self._seed]

    @property
    def manifest(self) -> dict[str, Any]:
        """The resolved manifest, with its `synthesis` section."""
        return self._sources.manifest.to_dict()

    def key(self, epoch: int, number: int, attempt: int) -> str:
        """The mesh file or the shape."""
        return self._body(epoch, number, attempt).item.source

    def part(self, epoch: int, number: int) -> int:
        """There is one alone."""
        return 0

    def sample(self, epoch: int, number: int, attempt: int) -> RawSample:
        """Draw and make a sample; each attempt draws another body for the same look.

        Raises:
            OcnfError: the mesh cannot be used.
        """
        manifest, request = self._sources.manifest, self.request
        assert request.encoding is not None
        body = self._body(epoch, number, attempt)
        look = draw_look(self._sources, self._seed, epoch, number)
        posed = pose(manifest, body, self._sources.meshes)

        def make(resolutions: tuple[int, ...]) -> dict[int, RawOctree]:
            return make_truths(manifest, posed, resolutions)

        truths = make(request.targets) if self._cache is None else self._cache.find(
            season_of(epoch, self._repeat), [self._seed, number, attempt], request.targets, make)
        inputs = make_inputs(manifest, posed, look, request.encoding, request.resolutions)
        octrees = {target_member(resolution): octree for resolution, octree in truths.items()}
        octrees |= {input_member(DRAWN_VARIANT, request.encoding, resolution): octree
                    for resolution, octree in inputs.items()}
        key = f"{body.item.key}-{epoch}-{number}"
        facts = _facts(key, body, look) | ({} if posed.scene is None else _scene_facts(posed.scene, look))
        return RawSample(key, body.item.category, facts, octrees)

    def _body(self, epoch: int, number: int, attempt: int) -> Body:
        return draw_body(self._sources, self._seed, season_of(epoch, self._repeat), number, attempt)


def _facts(key: str, body: Body, look: Look) -> dict[str, Any]:
    """What `Batch.meta` says of a sample: JSON values."""
    item = body.item
    return {
        "key": key, "split": item.split, "category": item.category, "source": item.source,
        "rotation": None if body.rotation is None else body.rotation.tolist(), "scale": body.scale,
        **({} if look.directions is None or body.is_scene else {"directions": look.directions.tolist()}),
        "views": list(look.views), "noise": str(look.noise),
        **({"sigma": look.sigma} if look.noise is NoiseModel.PARK else {"strength": look.strength}),
        **({"misaligned": look.misaligned} if look.misaligned else {}),
    }


def _scene_facts(scene: PlacedScene, look: Look) -> dict[str, Any]:
    """What it says beside that of a scene's sample."""
    return {"zoom": scene.body.zoom, "metres": scene.metres, "cameras": str(look.cameras),
            "background": look.background}
