// MuJoCo's state of one environment, and the motors' limits, which MJCF cannot hold.

/** Steps a scene under joint targets; `settings` are those of `scene.json`. */
export class Physics {
  constructor(mujoco, xml, settings) {
    this.mujoco = mujoco;
    this.substeps = settings.substeps;
    this.model = mujoco.MjModel.from_xml_string(xml);
    this.data = new mujoco.MjData(this.model);
    this.motors = new Motors(settings);
  }

  /** Starts from arrays by name: `qpos`, `qvel`, `mocap_pos`. */
  reset({ qpos, qvel, mocap_pos }) {
    this.mujoco.mj_resetData(this.model, this.data);
    this.data.qpos.set(qpos);
    this.data.qvel.set(qvel);
    this.data.mocap_pos.set(mocap_pos);
    this.mujoco.mj_kinematics(this.model, this.data);
  }

  /** One environment step under joint targets (R x 12), rad; PD control runs inside MuJoCo. */
  step(targets) {
    for (let i = 0; i < this.substeps; i++) {
      this.motors.limit(this.model, this.data, targets);
      this.mujoco.mj_step(this.model, this.data);
      this.motors.clamp(this.data);
    }
  }

  /** Frees MuJoCo's memory. */
  delete() {
    this.data.delete();
    this.model.delete();
  }
}

const clip = (x, low, high) => Math.max(low, Math.min(high, x));

/** The motors of all robots, as `mqe_jax/physics/robots/motors.py` computes them. */
class Motors {
  constructor(settings) {
    Object.assign(this, settings.motors);
    const all = (key) => settings.robots.flatMap((robot) => robot[key]);
    [this.qpos, this.qvel, this.actuator] = [all('joint_qpos'), all('joint_qvel'), all('actuator')];
    this.given = new Float64Array(this.qvel.length);
    this.velocity = new Float64Array(this.qvel.length);
  }

  /** Sets control and armature for one physics step under the asked control, by joint. */
  limit(model, data, asked) {
    const { qpos, qvel, ctrl } = data;
    const { velocity, given, speed, torque, stall, band, bias, actuator_gain: gain } = this;
    for (let i = 0; i < velocity.length; i++) {
      velocity[i] = qvel[this.qvel[i]];
      const [constant, stiffness, damping] = bias[i];
      const force = gain[i] * asked[i] + constant + stiffness * qpos[this.qpos[i]] + damping * velocity[i];
      const [over, under] = [speed[i] - velocity[i], -speed[i] - velocity[i]];
      const [line, brake] = [stall[i] / speed[i], torque[i] / (band * speed[i])];
      const upper = clip((over > 0 ? line : brake) * over, -torque[i], torque[i]);
      const lower = clip((under < 0 ? line : brake) * under, -torque[i], torque[i]);
      const wanted = clip(force, -torque[i], torque[i]);
      const result = Math.min(Math.max(wanted, lower), upper);
      ctrl[this.actuator[i]] = result === wanted ? asked[i] : asked[i] + (result - force) / gain[i];
      given[i] = result;
    }
    const armature = model.dof_armature;
    for (const [first, last, response] of this.runs) {
      for (let leg = first; leg < last; leg += response.length) this.setArmature(armature, leg, response);
    }
  }

  /** Sets the armature of the joints of one leg, which begin at `leg`. */
  setArmature(armature, leg, response) {
    const size = response.length;
    const { velocity, given, speed, torque, stall, timestep, band, slow, fast, reach, gain, steep } = this;
    let [fastest, lowest] = [0, Infinity];
    for (let i = leg; i < leg + size; i++) {
      fastest = Math.max(fastest, Math.abs(velocity[i]));
      lowest = Math.min(lowest, speed[i]);
    }
    const near = clip((fastest / lowest - slow) / (fast - slow), 0, 1);
    for (let j = 0; j < size; j++) {
      const i = leg + j;
      let kick = 0;
      for (let k = 0; k < size; k++) kick += response[k][j] * Math.abs(given[leg + k]);
      const full = (timestep * torque[i]) / (band * speed[i]);
      const reached = (Math.abs(velocity[i]) + timestep * kick) / speed[i];
      let needed = reached > reach ? clip((gain * (reached - 1)) / response[j][j], 0, full) : 0;
      const [line, inertia] = [stall[i] / speed[i], 1 / response[j][j]];
      if (timestep * line > steep * inertia) {
        const most = line * (speed[i] - velocity[i] * Math.sign(given[i]));
        const share = Math.min(Math.abs(given[i]) / Math.max(most, 1e-5), 1);
        needed = Math.max(share * (inertia + timestep * line) - inertia, 0);
      }
      armature[this.qvel[i]] = this.armature[i] + Math.max(near * full, needed);
    }
  }

  /** Bounds the joint speeds after a physics step. */
  clamp(data) {
    const { qpos, qvel } = data;
    for (let i = 0; i < this.qvel.length; i++) {
      const limit = this.clamped * this.speed[i];
      const velocity = qvel[this.qvel[i]];
      if (Math.abs(velocity) <= limit) continue;
      qvel[this.qvel[i]] = clip(velocity, -limit, limit);
      qpos[this.qpos[i]] -= this.timestep * (velocity - qvel[this.qvel[i]]);
    }
  }
}
