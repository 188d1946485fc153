// Episodes of a task: physics, the task's graphs, the skill of its robots and the policies of its teams.
import { Physics } from './physics.js';

/** Standard normal numbers from an integer: 32-bit xorshift and the Box-Muller transform. */
export function normalNumbers(seed) {
  let state = Math.imul(seed + 1, 0x9e3779b1) | 1;
  const uniform = () => {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    return ((state >>> 0) + 0.5) / 2 ** 32;
  };
  return () => Math.sqrt(-2 * Math.log(uniform())) * Math.cos(2 * Math.PI * uniform());
}

/** An ONNX graph with the recurrent states among its inputs. */
class Graph {
  constructor(ort, session, shapes) {
    Object.assign(this, { ort, session, shapes });
    this.reset();
  }

  /** Sets the recurrent states to zero. */
  reset() {
    this.memory = {};
  }

  /** The outputs by name of the inputs by name, arrays of numbers with `rows` rows; missing ones are zero. */
  async run(values, rows = 1) {
    const { Tensor } = this.ort;
    const feeds = {};
    for (const [name, [, ...shape]] of Object.entries(this.shapes.inputs)) {
      const array = new Float32Array(shape.reduce((a, b) => a * b, rows));
      if (values[name] !== undefined) array.set(values[name]);
      feeds[name] = this.memory[name] ?? new Tensor('float32', array, [rows, ...shape]);
    }
    const outputs = await this.session.run(feeds);
    for (const name of Object.keys(feeds)) {
      if (`next_${name}` in outputs && values[name] === undefined) this.memory[name] = outputs[`next_${name}`];
    }
    return Object.fromEntries(Object.entries(outputs).map(([name, tensor]) => [name, tensor.data]));
  }

  /** How many numbers an input has, 0 if it is missing. */
  size(name) {
    const shape = this.shapes.inputs[name];
    return shape ? shape.slice(1).reduce((a, b) => a * b, 1) : 0;
  }
}

/** Reads the files of a site; keeps what tasks share. */
export class Site {
  /** @param read function of a path that resolves to bytes. @param mujoco module. @param ort module. */
  constructor(read, mujoco, ort) {
    ort.env.wasm.numThreads = 1; // threads would need headers that a plain file server does not send
    Object.assign(this, { read, mujoco, ort, sessions: new Map() });
  }

  async json(path) {
    return JSON.parse(new TextDecoder().decode(await this.read(path)));
  }

  async graph(path, shapes) {
    if (!this.sessions.has(path)) this.sessions.set(path, this.ort.InferenceSession.create(await this.read(path)));
    return new Graph(this.ort, await this.sessions.get(path), shapes);
  }

  /** An episode of a task, not yet reset, with its first policy for all teams. */
  async episode(name) {
    const folder = `tasks/${name}`;
    const settings = await this.json(`${folder}/scene.json`);
    const { control, judge } = settings.graphs;
    const [xml, starts, ...graphs] = await Promise.all([
      this.read(`${folder}/scene.xml`).then((bytes) => new TextDecoder().decode(bytes)),
      this.read(`${folder}/starts.bin`).then((bytes) => new Float32Array(bytes.slice().buffer)),
      this.graph(`${folder}/control.onnx`, control),
      this.graph(`${folder}/judge.onnx`, judge),
      this.graph(settings.skill.file, settings.skill),
    ]);
    const episode = new Episode(this, folder, settings, new Physics(this.mujoco, xml, settings), starts, graphs);
    await Promise.all(settings.teams.map((_, team) => episode.choose(team, settings.policies[0].name)));
    return episode;
  }
}

/** One episode after another of a task. */
export class Episode {
  constructor(site, folder, settings, physics, starts, [control, judge, skill]) {
    Object.assign(this, { site, folder, settings, physics, starts, control, judge, skill });
    this.policies = settings.teams.map(() => null);
    this.names = settings.teams.map(() => 'idle');
    const [, agents, commands] = control.shapes.inputs.action;
    this.drive = new Float32Array(agents * commands); // actions of the agents that are driven by hand
    this.driven = new Float32Array(agents); // 1 where an agent is
  }

  /** Sets the policy of a team: one of `settings.policies`, or idle. */
  async choose(team, name) {
    const found = this.settings.policies.find((policy) => policy.name === name);
    this.policies[team] = found ? await this.site.graph(`${this.folder}/${found.file}`, found) : null;
    this.names[team] = found ? name : 'idle';
  }

  /** Starts from the initial state that a seed chooses. */
  reset(seed) {
    const { fields, constant, varying } = this.settings.starts;
    const count = this.starts.length / varying.length;
    const first = (((seed % count) + count) % count) * varying.length;
    const row = Float32Array.from(constant);
    varying.forEach((column, i) => (row[column] = this.starts[first + i]));
    const state = {};
    let position = 0;
    for (const [name, size] of fields) state[name] = row.slice(position, (position += size));
    this.normal = normalNumbers(seed);
    this.begin(state);
  }

  /** Starts from arrays by name: the state, `mocap_pos` and `obs`. */
  begin(state) {
    this.state = { ...state };
    this.obs = state.obs;
    this.physics.reset(state);
    this.skill.reset();
    this.policies.forEach((policy) => policy?.reset());
    this.steps = 0;
    this.outcome = Object.fromEntries(this.settings.outcomes.map((name) => [name, 0]));
    this.result = null; // how the episode ended: fall, collision, rule or time
  }

  /** The noise that a graph asks for. */
  noise(graph) {
    return Float32Array.from({ length: graph.size('noise') }, this.normal);
  }

  /** The actions of all agents. */
  async act() {
    const { teams } = this.settings;
    const width = this.obs.length / teams.flat().length;
    const parts = [];
    for (const [team, agents] of teams.entries()) {
      const policy = this.policies[team];
      const obs = this.obs.subarray(width * agents[0], width * (agents.at(-1) + 1));
      const size = (this.drive.length / this.driven.length) * agents.length;
      const seen = policy && { ...this.state, obs, team: [team], noise: this.noise(policy) };
      const action = policy ? (await policy.run(seen)).action : new Float32Array(size);
      parts.push(...action);
    }
    return parts;
  }

  /** One environment step. */
  async step() {
    const { drive, driven, state, physics } = this;
    const action = await this.act();
    const asked = await this.control.run({ ...state, action, drive, driven, noise: this.noise(this.control) });
    const { joint_target: targets } = await this.skill.run(asked, this.settings.robots.length);
    const [qpos, qvel, sensordata] = ['qpos', 'qvel', 'sensordata'].map((name) => state[name]);
    if (asked.next_qvel) physics.data.qvel.set(asked.next_qvel);
    if (asked.xfrc_applied) physics.data.xfrc_applied.set(asked.xfrc_applied);
    physics.step(targets);
    for (const name of ['qpos', 'qvel', 'sensordata']) state[name] = new Float32Array(physics.data[name]);
    this.steps += 1;
    state.step = [this.steps];
    const before = { before_qpos: qpos, before_qvel: qvel, before_sensordata: sensordata };
    const verdict = await this.judge.run({ ...state, ...before });
    for (const [name, value] of Object.entries(verdict)) if (name.startsWith('next_')) state[name.slice(5)] = value;
    this.obs = verdict.obs;
    this.settings.outcomes.forEach((name, i) => (this.outcome[name] = verdict.outcome[i]));
    if (verdict.terminated[0]) this.result = verdict.fell[0] ? 'fall' : verdict.collided[0] ? 'collision' : 'rule';
    else if (verdict.truncated[0]) this.result = 'time';
  }

  /** Frees the memory of the physics. */
  delete() {
    this.physics.delete();
  }
}
