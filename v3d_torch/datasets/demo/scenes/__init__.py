"""Scenes of the built-in sequences, by the name of the sequence."""

from collections.abc import Callable, Mapping

from v3d_torch.datasets.demo.scene import Scene
from v3d_torch.datasets.demo.scenes.sitting import build_sitting_scene
from v3d_torch.datasets.demo.scenes.things import build_things_scene
from v3d_torch.datasets.demo.scenes.walking import build_walking_scene

SCENES: Mapping[str, Callable[[int], Scene]] = {
    "demo": build_walking_scene,
    "demo:sitting": build_sitting_scene,
    "demo:things": build_things_scene,
}
"""Function that builds the scene of each built-in sequence from the seed of its textures."""
