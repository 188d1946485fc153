// Narrow Gate: its observation, and how an episode ends, as in `mqe_jax/envs/gate.py`.

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
