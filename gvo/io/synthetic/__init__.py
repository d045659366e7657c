"""Rendered recordings with exact ground truth."""

from gvo.io.synthetic.imu import ImuKind as ImuKind
from gvo.io.synthetic.imu import RenderedImu as RenderedImu
from gvo.io.synthetic.imu import rendered_imu as rendered_imu
from gvo.io.synthetic.recording import SyntheticRecording as SyntheticRecording
from gvo.io.synthetic.rendering import StillScene as StillScene
from gvo.io.synthetic.rig_error import RigError as RigError
from gvo.io.synthetic.scene import Light as Light
from gvo.io.synthetic.scene import Rectangle as Rectangle
from gvo.io.synthetic.scene import make_scene as make_scene
from gvo.io.synthetic.sensor import SensorNoise as SensorNoise
from gvo.io.synthetic.textures import Texture as Texture
from gvo.io.synthetic.world import Scenery as Scenery
from gvo.io.synthetic.world import World as World
from gvo.io.synthetic.world import WorldName as WorldName
