// Torques and speeds of the joints' motors in every physics step, as `mqe_jax/robots/motors.py` computes them.

const clip = (x, low, high) => Math.max(low, Math.min(high, x));

/** The motors of all robots: `settings.motors` of the scene. */
export class Motors {
  constructor(settings) {
    Object.assign(this, settings.motors);
    const all = (key) => settings.robots.flatMap((robot) => robot[key]);
    [this.qpos, this.qvel, this.actuator] = [all('joint_qpos'), all('joint_qvel'), all('actuator')];
  }

  /** Sets control and armature for one physics step under the asked control, by joint. */
  limit(model, data, asked) {
    const { speed, torque, stall, response, timestep, band, slow, fast, reach, gain } = this;
    const velocity = this.qvel.map((row) => data.qvel[row]);
    const given = asked.map((ctrl, i) => {
      const bias = this.bias[i];
      const force = this.actuator_gain[i] * ctrl + bias[0] + bias[1] * data.qpos[this.qpos[i]] + bias[2] * velocity[i];
      const wanted = clip(force, -torque[i], torque[i]);
      const [line, brake] = [stall[i] / speed[i], torque[i] / (band * speed[i])];
      const [over, under] = [speed[i] - velocity[i], -speed[i] - velocity[i]];
      const upper = clip((over > 0 ? line : brake) * over, -torque[i], torque[i]);
      const lower = clip((under < 0 ? line : brake) * under, -torque[i], torque[i]);
      const result = Math.min(Math.max(wanted, lower), upper);
      data.ctrl[this.actuator[i]] = result === wanted ? ctrl : ctrl + (result - force) / this.actuator_gain[i];
      return Math.abs(result);
    });
    const size = response.length;
    for (let leg = 0; leg < asked.length; leg += size) {
      const joints = response.map((_, j) => leg + j);
      const pace = joints.map((i) => Math.abs(velocity[i]));
      const lowest = Math.min(...joints.map((i) => speed[i]));
      const near = clip((Math.max(...pace) / lowest - slow) / (fast - slow), 0, 1);
      joints.forEach((i, j) => {
        const full = (timestep * torque[i]) / (band * speed[i]);
        const kick = response.reduce((sum, row, k) => sum + row[j] * given[leg + k], 0);
        const reached = (pace[j] + timestep * kick) / speed[i];
        const needed = reached > reach ? clip((gain * (reached - 1)) / response[j][j], 0, full) : 0;
        model.dof_armature[this.qvel[i]] = this.armature[i] + Math.max(near * full, needed);
      });
    }
  }

  /** Bounds the joint speeds after a physics step. */
  clamp(data) {
    this.qvel.forEach((row, i) => {
      const velocity = data.qvel[row];
      const clamped = clip(velocity, -this.clamped * this.speed[i], this.clamped * this.speed[i]);
      data.qpos[this.qpos[i]] -= this.timestep * (velocity - clamped);
      data.qvel[row] = clamped;
    });
  }
}
