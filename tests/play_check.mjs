// Runs the page's code in Node: node tests/play_check.mjs FOLDER < input.json > output.json
//
// FOLDER is a site of `mqe play-site`. Input: `task`, a folder in it; `rollouts`, each with a `start` (arrays by name),
// `actions` and `noise` by step; `episodes`, seeds to play with the task's first policy. Output: for each rollout `qpos`
// and `qvel` after every environment step, for each episode its end and outcome, and environment steps per second.
import fs from 'node:fs';
import path from 'node:path';
import { pathToFileURL } from 'node:url';

const folder = path.resolve(process.argv[2]);
const module = (name) => import(pathToFileURL(path.join(folder, name)).href);
const { default: loadMujoco } = await module('lib/mujoco.js');
const ort = await module('lib/ort.wasm.min.mjs');
const { Site } = await module('episode.js');

const input = JSON.parse(fs.readFileSync(0, 'utf8'));
const mujoco = await loadMujoco();
const site = new Site(async (name) => new Uint8Array(fs.readFileSync(path.join(folder, name))), mujoco, ort);

const rollouts = [];
const replayed = await site.episode(input.task);
for (const { start, actions, noise } of input.rollouts) {
  replayed.begin(start);
  const states = [];
  for (const [i, action] of actions.entries()) {
    replayed.act = async () => action.flat();
    replayed.noise = () => noise[i];
    await replayed.step();
    states.push({ qpos: [...replayed.physics.data.qpos], qvel: [...replayed.physics.data.qvel] });
  }
  rollouts.push({ qpos: states.map((state) => state.qpos), qvel: states.map((state) => state.qvel) });
}

const episodes = [];
let steps = 0;
const began = performance.now();
const episode = await site.episode(input.task);
for (const seed of input.episodes) {
  episode.reset(seed);
  while (episode.result === null) await episode.step();
  steps += episode.steps;
  episodes.push({ seed, result: episode.result, steps: episode.steps, outcome: { ...episode.outcome } });
}
const rate = steps ? (1000 * steps) / (performance.now() - began) : 0;
const report = { version: mujoco.mj_versionString(), rollouts, episodes, steps_per_second: rate };
process.stdout.write(JSON.stringify(report));
