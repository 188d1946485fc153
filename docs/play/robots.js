// State of the robots, as `mqe_jax/robots/index.py` reads it; quaternions wxyz, angles in rad.

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
