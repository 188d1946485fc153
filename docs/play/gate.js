// Narrow Gate: the robots' states as `mqe_jax/robots/index.py` reads them, the observation, and how an episode ends, as in
// `mqe_jax/envs/gate.py`; quaternions wxyz, angles in rad.

/** Roll, pitch and yaw of a quaternion, applied in the order z, y, x. */
export function euler([w, x, y, z]) {
  const sine = Math.max(-1, Math.min(1, 2 * (w * y - z * x)));
  return [
    Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
    Math.asin(sine),
    Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
  ];
}

/** Unit gravity vector in the frame of a body with this quaternion. */
export function gravity([w, x, y, z]) {
  return [2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1];
}

/** Quaternion of a rotation about z. */
export function turn(yaw) {
  return [Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)];
}

/**
 * The robots' states.
 * @param settings of the scene: `mqe_jax.export.scene.scene_settings`.
 * @param data with `qpos`, `qvel` and `sensordata`.
 */
export function readRobots(settings, data) {
  const pick = (values, addresses) => addresses.map((address) => values[address]);
  return settings.robots.map((robot) => {
    const base = pick(data.qpos, robot.base_qpos);
    const forces = robot.trunk_force.map((addresses) => Math.hypot(...pick(data.sensordata, addresses)));
    const quaternion = base.slice(3);
    return {
      position: base.slice(0, 3),
      euler: euler(quaternion),
      gravity: gravity(quaternion),
      jointPosition: pick(data.qpos, robot.joint_qpos),
      jointVelocity: pick(data.qvel, robot.joint_qvel),
      trunkForce: Math.max(...forces),
    };
  });
}

/** Observations of both agents, blocks in the order of `observation_layout`. */
export function observe(settings, robots, anchors) {
  const base = robots.map((robot) => [...robot.position, ...robot.euler]);
  const blocks = (agent) => ({
    one_hot: agent === 0 ? [1, 0] : [0, 1],
    base: base[agent],
    teammate: base[1 - agent],
    gate: anchors[0],
  });
  return robots.map((_, agent) => {
    const values = blocks(agent);
    return settings.observation.flatMap(([name]) => values[name]);
  });
}

/** 'success', 'collision', 'fall' or 'time' where the episode has ended, otherwise null. */
export function outcome(settings, robots, anchors, steps) {
  const limits = settings.params;
  const fell = ({ position, euler: [roll, pitch] }) =>
    Math.abs(roll) > limits.max_roll ||
    Math.abs(pitch) > limits.max_pitch ||
    // Negated, so that a number that is not finite counts as a fall.
    !(position[2] >= limits.min_height && position[2] <= limits.max_height);
  if (robots.some(fell)) return 'fall';
  if (limits.end_on_collision && robots.some((robot) => robot.trunkForce > limits.collision_force)) return 'collision';
  if (steps < settings.max_steps) return null;
  const line = anchors[0][0] + limits.past_gate;
  return robots.every(({ position }) => position[0] > line) ? 'success' : 'time';
}

/** Which robots are through the gate. */
export function through(settings, robots, anchors) {
  return robots.map(({ position }) => position[0] > anchors[0][0] + settings.params.past_gate);
}
