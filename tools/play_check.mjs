// Runs the page's code in Node: node tools/play_check.mjs FOLDER < input.json > output.json
//
// FOLDER is a completed play/ (tools/play.py). Input: `rollouts`, each with `qpos`, `qvel`, `anchors` and `targets`
// (T x R x 12), and `episodes`, seeds to play with the policy. Output: for each rollout `qpos` and `qvel` after every
// environment step, for each episode how it ended, and the environment steps per second of the episodes.
import fs from 'node:fs';
import path from 'node:path';
import { pathToFileURL } from 'node:url';

const folder = path.resolve(process.argv[2]);
const module = (name) => import(pathToFileURL(path.join(folder, name)).href);
const { default: loadMujoco } = await module('lib/mujoco.js');
const ort = await module('lib/ort.wasm.min.mjs');
const { loadEpisode } = await module('episode.js');

const input = JSON.parse(fs.readFileSync(0, 'utf8'));
const read = async (name) => new Uint8Array(fs.readFileSync(path.join(folder, name)));
const episode = await loadEpisode(read, loadMujoco, ort);
const { physics } = episode;

const rollouts = input.rollouts.map((rollout) => {
  physics.reset(rollout);
  const states = rollout.targets.map((targets) => {
    physics.step(targets.flat());
    return { qpos: [...physics.data.qpos], qvel: [...physics.data.qvel] };
  });
  return { qpos: states.map((state) => state.qpos), qvel: states.map((state) => state.qvel) };
});

const episodes = [];
let steps = 0;
const began = performance.now();
for (const seed of input.episodes) {
  episode.reset(seed);
  while (episode.result === null) await episode.step();
  steps += episode.steps;
  episodes.push({ seed, result: episode.result, steps: episode.steps });
}
const seconds = (performance.now() - began) / 1000;
const version = physics.mujoco.mj_versionString();
process.stdout.write(JSON.stringify({ version, rollouts, episodes, steps_per_second: seconds ? steps / seconds : 0 }));
