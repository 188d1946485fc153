"""Scripted policies of Narrow Gate, Climb on Seesaw, Sheep Dog and Push Box."""

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.policies.scripted import GAIN, Observation, go_to, pose
from mqe_jax.terrain import ROW, rows_of

# Narrow Gate: the first robot passes the gate while the second waits until the gate is clear. Of
# more than two robots the others stand until the one before them is through. Each walks across the
# track behind the gate, then ahead to its place; the places of the first ones are at the far end.
_WIDTH = 3.0  # m, of the track
_LANE_X = 4.65  # m, x of the way across, at most


def plan_gate(obs: Observation) -> jax.Array:
    """Returns the robots' actions (A, 3)."""
    (position, yaw) = pose(obs["base"])
    gate = obs["gate"]
    agents = len(position)
    before = gate - jnp.array([0.65, 0.0])
    behind = gate + jnp.array([0.75, 0.0])
    wait = (gate + jnp.array([[-0.65, -0.7], [-1.3, 0.7]])[:agents]) if agents < 3 else position
    rest = jnp.asarray(_rest(agents))
    x, y = (position - gate).T
    free = x[:-1] > 0.9
    if agents > 2:
        across = jnp.minimum(behind[:, 0], _LANE_X)
        rest = jnp.where(
            jnp.abs(position[:, 1:] - rest[:, 1:]) < 0.1, rest, rest.at[:, 0].set(across)
        )
        free |= (x[:-1] > 0.4) & (jnp.abs(y[:-1]) > 0.6)
    lined_up = (jnp.abs(y) < 0.1) & (x > -1.0)
    goal = jnp.where((lined_up | (x > -0.3))[:, None], behind, before)
    goal = jnp.where((x > 0.6)[:, None], rest, goal)
    free = jnp.concatenate([jnp.array([True]), free])
    return go_to(position, yaw, jnp.where(free[:, None] | (x > 0.0)[:, None], goal, wait))


def _rest(agents: int) -> np.ndarray:
    """Returns where robots rest beyond the gate (A, 2), m, mirrored from where they start."""
    columns, behind = rows_of(agents, _WIDTH)
    place = np.arange(agents)
    row = place // columns
    count = np.minimum(columns, agents - place // columns * columns)
    across = (place % columns - (count - 1) / 2) * _WIDTH / columns
    last = 5.3 if agents < 3 else 5.5
    return np.stack([last + behind - ROW * row, -across], axis=-1).astype(np.float32)


# Climb on Seesaw: one robot walks up to the platform, the other stands on the plank's near end.
_TOP = 8.1  # m, x of the climber's goal on the platform
_NEAR_END = 3.87  # m, x at which the partner has all four feet on the plank
_BEHIND = 0.9  # m, distance of the partner behind the climber
# The climber steps onto the centre of the 1 m wide plank; with the feet of one side off the plank
# it would tip over.
_FOOT = 2.6  # m, x of the climber's goal while it is off-centre
_ENTRY = 2.9  # m, x up to which the climber stops if it is more than _CENTRED off-centre
_CENTRED = 0.15  # m
_LOW = 4.4  # m, x up to which the climber goes back if it is more than _EDGE off-centre
_EDGE = 0.3  # m, distance from the centre line at which the outer feet are near the plank's edge


def plan_seesaw(obs: Observation) -> jax.Array:
    """Returns both robots' actions (2, 3)."""
    position, yaw = pose(obs["base"])
    x = position[0, 0]
    offset = jnp.abs(position[0, 1])
    off = ((x < _ENTRY) & (offset > _CENTRED)) | ((x < _LOW) & (offset > _EDGE))
    climb = jnp.where(off, _FOOT, _TOP)
    follow = jnp.minimum(x - _BEHIND, _NEAR_END)
    goal = jnp.zeros((2, 2)).at[:, 0].set(jnp.stack([climb, follow]))
    return go_to(position, yaw, goal)


# Sheep Dog: drive one sheep from behind, or gather a flock towards the gate.
_BESIDE = 0.7  # m, between robots that walk behind one sheep
_FREE = 1.2  # m, between robots below which those of a larger team keep apart
# m, between centres
_CLEAR_OF_SHEEP = 0.62
_CLEAR_OF_ROBOTS = 0.85
# m, of robots: the least distance before the gate, the greatest |y|
_STOP_X = 0.62
_WALK_Y = 2.7
_FASTEST = (1.0, 0.5)  # m/s, along x and y
_BRAKING = 2.5  # 1/s, approach speed per distance that is left


def _sides(obs: Observation) -> np.ndarray | jax.Array:
    """Returns each robot's side of the sheep's path (A, 1), from -1 (right) to 1 (left)."""
    agents = len(obs["base"])
    if "active" not in obs:
        place = np.arange(agents) - (agents - 1) / 2
        return (2 * place / max(agents - 1, 1)).astype(np.float32)[:, None]
    last = jnp.sum(obs["active"]) - 1
    return ((2.0 * (jnp.cumsum(obs["active"]) - 1) - last) / jnp.maximum(last, 1))[:, None]


def _apart(position: jax.Array, goal: jax.Array) -> jax.Array:
    """Returns the goals (A, 2), m, moved away from other robots that are close.

    Goals of teams of at most two robots stay as they are.
    """
    if len(position) < 3:
        return goal
    between = position[:, None] - position[None]
    close = jnp.linalg.norm(between, axis=-1) + _FREE * jnp.eye(len(position))
    return goal + jnp.sum(jnp.maximum(_FREE / close - 1.0, 0.0)[..., None] * between, axis=1)


def plan_sheep_easy(obs: Observation) -> jax.Array:
    """Returns the robots' actions (A, 3).

    They walk behind the sheep, side by side across the line from the gate through it, and stop when
    it is through. Of several sheep they drive the mean of those that are not.
    """
    (position, yaw) = pose(obs["base"])
    gate = obs["gate"][0]
    sheep = obs["sheep"][0].reshape(-1, 2)
    left = (sheep[:, 0] <= gate[0] + 0.4).astype(jnp.float32)
    sheep = left @ sheep / jnp.maximum(jnp.sum(left), 1)
    way = gate + jnp.array([0.6, 0.0]) - sheep
    way = way / jnp.maximum(jnp.linalg.norm(way), 1e-3)
    across = jnp.array([-way[1], way[0]])
    goal = sheep - 0.8 * way + _BESIDE * (len(position) - 1) / 2 * _sides(obs) * across
    return jnp.where(jnp.sum(left) > 0, go_to(position, yaw, _apart(position, goal)), 0.0)


def plan_sheep_hard(obs: Observation) -> jax.Array:
    """Returns the robots' actions (A, 3).

    Teams of two or three divide the flock by sides, larger ones by distance.
    """
    if "active" in obs:
        number = jnp.sum(obs["active"])
        return jnp.where(
            (number == 2) | (number == 3), _drive_by_side(obs), plan_sheep_by_distance(obs)
        )
    return (_drive_by_side if len(obs["base"]) in (2, 3) else plan_sheep_by_distance)(obs)


def _drive_by_side(obs: Observation) -> jax.Array:
    """Returns the actions (A, 3) of robots that each prefer one side of the flock.

    Each robot walks behind a weighted mean of the sheep positions; weights are larger for sheep far
    from the gate, on the robot's side and close to it. Stragglers are driven back to the flock,
    whose cohesion keeps it together. Of three robots the middle one prefers no side, and robots
    keep apart.
    """
    side = _sides(obs)
    (position, yaw) = pose(obs["base"])
    gate = obs["gate"][0]
    sheep = obs["sheep"][0].reshape(-1, 2)
    through = sheep[:, 0] > gate[0]
    way = sheep - gate - jnp.array([0.8, 0.0])
    apart = position[:, None] - sheep[None]
    near = jnp.linalg.norm(apart, axis=-1)
    own_side = side * (sheep[:, 1] - gate[1])
    score = 5.0 * jnp.linalg.norm(way, axis=-1) + 3.5 * own_side - 1.5 * near
    weight = jax.nn.softmax(jnp.where(through, -1e3, score), axis=-1)
    back = weight @ way
    back /= jnp.maximum(jnp.linalg.norm(back, axis=-1, keepdims=True), 1e-3)
    goal = weight @ sheep + 0.8 * back + side * jnp.array([0.0, 0.2])
    goal = jnp.clip(goal, jnp.array([0.0, -2.6]), jnp.stack([gate[0] - 0.45, 2.6]))
    # Repulsion from close sheep.
    goal += jnp.sum(0.8 * jnp.maximum(0.75 / near - 1.0, 0.0)[..., None] * apart, axis=1)
    return jnp.where(jnp.all(through), 0.0, go_to(position, yaw, _apart(position, goal)))


def plan_sheep_by_distance(obs: Observation) -> jax.Array:
    """Returns the actions (A, 3) of any number of robots, whatever their order.

    Each robot walks behind a weighted mean of the sheep positions. Weights are larger for sheep
    that are far from the gate, that the robot is behind, or that no other robot is closer to.
    Robots brake before they touch each other, a sheep or the gate's wall, which would end the
    episode.
    """
    (position, yaw) = pose(obs["base"])
    gate = obs["gate"][0]
    sheep = obs["sheep"][0].reshape(-1, 2)
    through = sheep[:, 0] > gate[0]
    way = sheep - gate - jnp.array([0.8, 0.0])
    far = jnp.linalg.norm(way, axis=-1)
    apart = position[:, None] - sheep[None]
    near = jnp.linalg.norm(apart, axis=-1)
    behind = jnp.sum(apart * way, axis=-1) / jnp.maximum(far * near, 1e-3)  # cosine of an angle
    score = 7.2 * far + 1.6 * behind - 3.0 * near - 3.0 * (near - jnp.min(near, axis=0))
    weight = jax.nn.softmax(jnp.where(through, -1e3, score), axis=-1)
    back = weight @ way
    back /= jnp.maximum(jnp.linalg.norm(back, axis=-1, keepdims=True), 1e-3)
    last = gate[0] - _STOP_X
    goal = _apart(position, weight @ sheep + 0.8 * back)
    goal = jnp.clip(goal, jnp.array([0.2, -_WALK_Y]), jnp.stack([last, _WALK_Y]))
    velocity = jnp.clip(0.9 * (goal - position), -jnp.array(_FASTEST), jnp.array(_FASTEST))
    for _ in range(2):
        velocity = _brake(velocity, apart, _CLEAR_OF_SHEEP)
        velocity = _brake(velocity, position[:, None] - position[None], _CLEAR_OF_ROBOTS)
    (x, y) = position.T
    (ahead, left) = velocity.T
    ahead = jnp.minimum(ahead, _BRAKING * (last - x))
    left = jnp.clip(left, -_BRAKING * (_WALK_Y + y), _BRAKING * (_WALK_Y - y))
    velocity = jnp.stack([ahead, left], axis=-1)
    return jnp.where(jnp.all(through), 0.0, go_to(position, yaw, position + velocity / GAIN))


def _brake(velocity: jax.Array, apart: jax.Array, least: float) -> jax.Array:
    """Returns velocities (A, 2), m/s, that keep robots at a distance from others.

    Args:
        velocity: wanted (A, 2), m/s.
        apart: positions of the robots relative to the others (A, K, 2), m; a robot is not kept from
            itself.
        least: the distance, m.
    """
    distance = jnp.linalg.norm(apart, axis=-1, keepdims=True)
    away = apart / jnp.maximum(distance, 1e-3)
    approach = -jnp.sum(velocity[:, None] * away, axis=-1, keepdims=True)
    return velocity + jnp.sum(
        jnp.maximum(approach - _BRAKING * (distance - least), 0.0) * away, axis=1
    )


# Push Box: both robots push the box side by side and correct its heading.
_PUSH_FROM = 0.95  # m, from the box's centre to a robot before it pushes
_APART = 0.6  # m, between two robots that push side by side, at most
_ABREAST = 3  # robots that push side by side, at most; further rows push the robots before them
_FACE = 0.8  # m, of the box's face on which they push
_LENGTH = 0.8  # m, between the rows
# m, of travel along the box's heading over which its lateral error is predicted; damps the steering
_LOOKAHEAD = 0.4


def plan_pushbox(obs: Observation) -> jax.Array:
    """Returns the robots' actions (A, 3)."""
    (position, yaw) = pose(obs["base"])
    gate = obs["gate"][0]
    box = obs["box"][0]
    row, column, columns = _places(len(position))
    lateral = column * min(_APART, _FACE / max(columns - 1, 1))
    w, x, y, z = obs["box_quaternion"][0]
    turned = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    # the box is symmetric under quarter turns
    turned = (turned + jnp.pi / 4) % (jnp.pi / 2) - jnp.pi / 4
    # Predicted lateral offset of the gate's centre from the box.
    offset = jnp.clip(gate[1] - box[1] - _LOOKAHEAD * jnp.sin(turned), -0.5, 0.5)
    along = jnp.array([jnp.cos(turned), jnp.sin(turned)])
    across = jnp.array([-jnp.sin(turned), jnp.cos(turned)])
    place = box - (_PUSH_FROM + _LENGTH * row)[:, None] * along + lateral[:, None] * across
    apart = position - box
    behind = apart @ along < -0.55
    lined_up = behind & (jnp.abs(apart @ across - lateral) < 0.15)
    ready = jnp.all(lined_up | ~obs.get("active", np.ones(len(position), bool)))
    # The robot on the side to which the box should turn pushes less.
    heading = jnp.clip(1.2 * offset, -0.35, 0.35)
    lead = jnp.clip(4.0 * (heading - turned), -0.7, 0.7) * -2.0 * column / max(columns - 1, 1)
    walk = go_to(position, yaw, place, turned)
    push = walk.at[:, 0].set(jnp.clip(0.4 + 0.5 * lead, 0.1, 0.5))
    return jnp.where(ready, push, walk)


def _places(agents: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Returns each robot's row and column (A,) behind the box, and the number of columns.

    Columns count from the middle one.
    """
    columns = min(agents, _ABREAST)
    place = np.arange(agents)
    count = np.minimum(columns, agents - place // columns * columns)
    return place // columns, (place % columns - (count - 1) / 2).astype(np.float32), columns
