"""What input may hold and cost: the one list of bounds.

Whatever is outside of them raises an `InputError`.

Kinds of numbers are types of settings (`settings_class`) and of arguments (`checked`). A
plain `int` or `float` has the bounds of `Integer` or `Number`. The constants bound files, texts and
memory.
"""

import math
import typing
from collections.abc import Sequence
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen

# -- numbers: finite, within both bounds
Number = Annotated[float, Ge(-1e9), Le(1e9)]
Positive = Annotated[float, Ge(1e-9), Le(1e9)]
NonNegative = Annotated[float, Ge(0), Le(1e9)]
Fraction = Annotated[float, Ge(0), Le(1)]
Length = Annotated[float, Ge(1e-3), Le(1e3)]  # of a body or a scene, m
Distance = Annotated[float, Ge(0), Le(1e3)]  # m
Coordinate = Annotated[float, Ge(-1e3), Le(1e3)]  # in the environment's frame, m
Mass = Annotated[float, Ge(1e-3), Le(1e4)]  # kg, or a moment of inertia, kg m^2
Degrees = Annotated[float, Ge(0), Le(360)]
Payload = Annotated[float, Ge(-100), Le(100)]  # of a robot, kg
Offset = Annotated[float, Ge(-1), Le(1)]  # within a robot, m
Factor = Annotated[float, Ge(1e-3), Le(100)]  # on a motor's torque, or a joint's mechanics
Angle = Annotated[float, Ge(0), Le(math.pi)]  # rad
Tilt = Annotated[float, Ge(0.05), Le(1e9)]  # at which an episode ends, rad
Velocity = Annotated[float, Ge(0), Le(100)]  # m/s, or rad/s
Force = Annotated[float, Ge(0), Le(1e4)]  # N
Deviation = Annotated[float, Ge(0), Le(1e3)]  # of noise on an observation
Damping = Annotated[float, Ge(0), Le(1e5)]  # N s/m, or N m s/rad
Friction = Annotated[float, Ge(0), Le(100)]
PositiveFriction = Annotated[float, Ge(1e-3), Le(100)]
TimeLimit = Annotated[float, Ge(0.02), Le(1e6)]  # of an episode, s; not below one environment step
Time = Annotated[float, Ge(0), Le(1e4)]  # s
Latency = Annotated[float, Ge(0), Le(1)]  # of a message, s
ClipLength = Annotated[float, Ge(0.02), Le(600)]  # s
FrameRate = Annotated[float, Ge(0.1), Le(240)]  # Hz
Speed = Annotated[float, Ge(0.01), Le(100)]  # of a clip, relative to real time

# -- counts: integers, not numbers with a fraction, NaN or booleans
Integer = Annotated[int, Ge(-(10**12)), Le(10**12)]
PositiveInt = Annotated[int, Gt(0), Le(10**6)]
NonNegativeInt = Annotated[int, Ge(0), Le(10**6)]
Seed = Annotated[int, Ge(0), Lt(2**32)]
Steps = Annotated[int, Gt(0), Lt(10**12)]  # environment steps of a training
Environments = Annotated[int, Gt(0), Le(2**17)]  # in parallel; their memory is checked too
Episodes = Annotated[int, Gt(0), Le(2 * 10**6)]
Candidates = Annotated[int, Gt(0), Le(1024)]  # episodes recorded, or played by each pair, at once
Horizon = Annotated[int, Gt(0), Le(10**4)]  # environment steps in one program
Robots = Annotated[int, Gt(0), Le(64)]  # of a scene
FlockSize = Annotated[int, Gt(0), Le(128)]  # sheep
Few = Annotated[int, Gt(0), Le(16)]  # rows of sheep
SeedCount = Annotated[int, Gt(0), Le(64)]  # trained in one program
Seeds = Annotated[Sequence[Seed], MinLen(1), MaxLen(64)]  # as many
Lag = Annotated[int, Ge(0), Le(50)]  # environment steps
Members = Annotated[int, Gt(0), Le(256)]  # of a league's pool
Epochs = Annotated[int, Gt(0), Le(1000)]
Iterations = Annotated[int, Gt(0), Le(100)]  # of the solver
Buffer = Annotated[int, Gt(0), Le(1000)]  # contacts or constraints per robot
Width = Annotated[int, Gt(0), Le(2048)]  # of a layer
Depth = Annotated[int, Gt(0), Le(16)]  # layers or blocks of a network
Widths = Annotated[tuple[Width, ...], MinLen(1), MaxLen(16)]  # of all layers
Pixels = Annotated[int, Ge(16), Le(4096)]  # of one side of an image
ImageWidth = Annotated[int, Ge(27), Le(4096)]  # at 16:9, whose height has 16 pixels or more
Rays = Annotated[int, Gt(0), Le(1024)]  # of a lidar
Port = Annotated[int, Gt(0), Lt(65536)]

# -- texts, settings and files
TEXT = 4096  # characters of a name or a path, none of which is a control character
FILE_NAME = 255  # bytes of a part of a path
VARIANT = 50  # characters of the name of a variant, with which folders are named
SHOWN = 200  # characters of a value in a message
DEPTH = 32  # nesting of settings
YAML_BYTES = 2**17
FILE_BYTES = 2**28  # of other files; of an archive, all members and all tensors
CHECKPOINT_BYTES = 2**34
MJCF_BYTES = 2**20  # of a file of an MJCF
MJCF_FILES = 16  # that make an MJCF
MJCF_ELEMENTS = 5000  # of an MJCF
MJCF_DEPTH = 64  # of its elements within each other
MESH_BYTES = 2**25  # of a mesh
MESHES_BYTES = 2**27  # of all meshes of a robot
MESH_POINTS = 2 * 10**6  # of a robot's geoms, those of one mesh counted by each geom
ROBOT_BODIES = 256
ROBOT_JOINTS = 64
WEIGHT = 1e4  # magnitude of a policy's or a skill's weight; trained ones are below 10

# -- memory, checked before it is allocated
CLIP_BYTES = 2**30  # recorded episodes; images of a clip that is not streamed
MEMORY_SHARE = 0.5  # of the free memory, for the states of all environments or for a rollout


def bounds(kind: Any) -> tuple[float, float]:
    """Returns the lowest and the highest allowed number of a kind.

    An exclusive bound of an integer is the first number inside.
    """
    step = int(typing.get_args(kind)[0] is int)
    given: Any = kind.__metadata__
    low = [
        *(x.ge for x in given if hasattr(x, "ge")),
        *(x.gt + step for x in given if hasattr(x, "gt")),
    ]
    high = [
        *(x.le for x in given if hasattr(x, "le")),
        *(x.lt - step for x in given if hasattr(x, "lt")),
    ]
    return max(low, default=-math.inf), min(high, default=math.inf)
