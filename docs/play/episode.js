// Episodes of a task in MuJoCo, driven by a policy exported by `mqe export` to ONNX.
import { observe, outcome, readRobots, turn } from './gate.js';

/** A generator of numbers in [0, 1): 32-bit xorshift, started by an integer. */
export function random(seed) {
  let state = Math.imul(seed + 1, 0x9e3779b1) | 1;
  return () => {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    return (state >>> 0) / 2 ** 32;
  };
}

/** An initial state sampled as `QuadrupedEnv.reset` does, from another generator. */
export function sampleStart(settings, seed) {
  const next = random(seed);
  const around = (middle, width) => middle + width * (2 * next() - 1);
  const { params, spawn } = settings;
  const [low, high] = params.spawn_joint_scale;
  const qpos = Float64Array.from(settings.qpos0);
  const qvel = new Float64Array(settings.num_velocities);
  const anchors = settings.anchors.mean.map((mean, i) => mean.map((x, j) => around(x, settings.anchors.spread[i][j])));
  settings.robots.forEach((robot, number) => {
    const [x, y, z, yaw] = spawn[number];
    const place = [around(x, params.spawn_noise), around(y, params.spawn_noise), z];
    [...place, ...turn(yaw)].forEach((value, i) => (qpos[robot.base_qpos[i]] = value));
    robot.joint_qpos.forEach((address, i) => {
      const angle = settings.default_joints[i] * (low + (high - low) * next());
      qpos[address] = Math.max(settings.joint_lower[i], Math.min(settings.joint_upper[i], angle));
    });
    robot.base_qvel.forEach((address) => (qvel[address] = around(0, params.spawn_velocity)));
  });
  return { qpos, qvel, anchors };
}

/** MuJoCo's state of one environment. */
export class Physics {
  constructor(mujoco, xml, settings) {
    this.mujoco = mujoco;
    this.settings = settings;
    this.model = mujoco.MjModel.from_xml_string(xml);
    this.data = new mujoco.MjData(this.model);
    this.motors = new Motors(settings);
  }

  /** Starts from a state; joint targets are neutral until the first step. */
  reset({ qpos, qvel, anchors }) {
    this.mujoco.mj_resetData(this.model, this.data);
    this.data.qpos.set(qpos);
    this.data.qvel.set(qvel);
    const walls = this.settings.walls;
    this.data.mocap_pos.set(
      walls.flatMap(({ anchor, offset }) => offset.map((x, i) => x + (anchors[anchor][i] ?? 0))),
    );
  }

  /** One environment step under joint targets (R x 12), rad; PD control runs inside MuJoCo. */
  step(targets) {
    for (let i = 0; i < this.settings.substeps; i++) {
      this.motors.limit(this.model, this.data, Array.from(targets));
      this.mujoco.mj_step(this.model, this.data);
      this.motors.clamp(this.data);
    }
  }
}

/** A policy and its recurrent state. */
export class Policy {
  constructor(ort, session, shapes) {
    this.ort = ort;
    this.session = session;
    this.shapes = shapes;
    this.reset();
  }

  /** Sets all recurrent states to zero. */
  reset() {
    this.memory = {};
    for (const [name, shape] of Object.entries(this.shapes.inputs)) {
      if (`next_${name}` in this.shapes.outputs) this.memory[name] = this.tensor(name, []);
    }
  }

  /** The outputs of one step by name, of the agents' inputs by name: arrays of numbers. */
  async act(inputs) {
    const feeds = { ...this.memory };
    for (const [name, values] of Object.entries(inputs)) feeds[name] = this.tensor(name, values);
    const outputs = await this.session.run(feeds);
    for (const name of Object.keys(this.memory)) this.memory[name] = outputs[`next_${name}`];
    return outputs;
  }

  tensor(name, values) {
    const shape = [1, ...this.shapes.inputs[name].slice(1)];
    const array = new Float32Array(shape.reduce((a, b) => a * b));
    array.set(values);
    return new this.ort.Tensor('float32', array, shape);
  }
}

/** An episode: physics, policy and the task's rules. */
export class Episode {
  constructor(physics, policy) {
    this.physics = physics;
    this.policy = policy;
    this.settings = physics.settings;
  }

  reset(seed) {
    const start = sampleStart(this.settings, seed);
    this.physics.reset(start);
    this.policy.reset();
    this.anchors = start.anchors;
    this.steps = 0;
    this.robots = readRobots(this.settings, this.physics.data);
    this.result = null;
  }

  /** One environment step; `result` says how the episode ended, or null. */
  async step() {
    const all = (key) => this.robots.flatMap((robot) => robot[key]);
    const outputs = await this.policy.act({
      obs: observe(this.settings, this.robots, this.anchors).flat(),
      gravity: all('gravity'),
      joint_position: all('jointPosition'),
      joint_velocity: all('jointVelocity'),
    });
    this.commands = outputs.commands.data;
    this.physics.step(outputs.joint_target.data);
    this.steps += 1;
    this.robots = readRobots(this.settings, this.physics.data);
    this.result = outcome(this.settings, this.robots, this.anchors, this.steps);
  }
}

/**
 * Returns an episode, not yet reset, from a folder of files.
 * @param read function of a file's name that resolves to its bytes (Uint8Array).
 * @param loadMujoco the loader that `@mujoco/mujoco` exports.
 * @param ort the module of `onnxruntime-web`.
 */
export async function loadEpisode(read, loadMujoco, ort) {
  const text = async (name) => new TextDecoder().decode(await read(name));
  ort.env.wasm.numThreads = 1; // threads would need headers that a plain file server does not send
  const [mujoco, xml, settings, onnx] = await Promise.all([
    loadMujoco(),
    text('scene.xml'),
    text('scene.json').then(JSON.parse),
    read('policy.onnx'),
  ]);
  const session = await ort.InferenceSession.create(onnx);
  const policy = new Policy(ort, session, settings.policy);
  return new Episode(new Physics(mujoco, xml, settings), policy);
}

const clip = (x, low, high) => Math.max(low, Math.min(high, x));

/** The motors of all robots, as `mqe_jax/robots/motors.py` computes them: `settings.motors` of the scene. */
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
