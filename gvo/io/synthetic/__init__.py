"""Rendered recordings with exact ground truth."""

from gvo.io.synthetic.recording import SyntheticRecording
from gvo.io.synthetic.rendering import StillScene
from gvo.io.synthetic.rig_error import RigError
from gvo.io.synthetic.scene import Light, Rectangle, make_scene
from gvo.io.synthetic.sensor import SensorNoise
from gvo.io.synthetic.textures import Texture
from gvo.io.synthetic.world import Scenery, World, WorldName

__all__ = [
    "Light",
    "Rectangle",
    "RigError",
    "Scenery",
    "SensorNoise",
    "StillScene",
    "SyntheticRecording",
    "Texture",
    "World",
    "WorldName",
    "make_scene",
]
