// The page: loads MuJoCo, the scene and the policy, then plays episodes one after another.
import { through } from './gate.js';
import { loadEpisode } from './episode.js';

const PAUSE_AFTER = 1.0; // s of page time between two episodes
const LONGEST_FRAME = 0.1; // s of simulation at most in one frame, so that a slow browser stays responsive

const element = (id) => document.getElementById(id);
const options = new URLSearchParams(location.search);
const page = { playing: true, speed: Number(options.get('speed') ?? 1), seed: Number(options.get('seed') ?? 0) };
const results = [];

async function read(name) {
  const response = await fetch(name);
  if (!response.ok) throw new Error(`${name}: ${response.status} ${response.statusText}`);
  return new Uint8Array(await response.arrayBuffer());
}

async function load() {
  const [{ default: loadMujoco }, ort, { Drawing }] = await Promise.all([
    import('./lib/mujoco.js'),
    import('./lib/ort.wasm.min.mjs'),
    import('./drawing.js'),
  ]);
  const episode = await loadEpisode(read, loadMujoco, ort);
  const { mujoco, model, settings } = episode.physics;
  element('version').textContent = `MuJoCo ${mujoco.mj_versionString()}`;
  const agreement = JSON.parse(new TextDecoder().decode(await read('agreement.json')));
  const after = (quantity) => agreement.environment['20'][quantity].toExponential(1);
  element('agreement').textContent =
    `Under the same joint targets, MuJoCo ${agreement.browser} in the browser and ${agreement.here} in the package ` +
    `differ by at most ${after('trunk position, m')} m and ${after('joint angle, rad')} rad after 20 steps.`;
  return { episode, drawing: new Drawing(element('canvas'), model, settings) };
}

function show(episode) {
  const { settings, robots, anchors, commands } = episode;
  element('time').textContent = `${(episode.steps * settings.dt).toFixed(1)} s of ${settings.params.episode_length} s`;
  const passed = through(settings, robots, anchors);
  robots.forEach((robot, i) => {
    const [vx, vy, yaw] = commands ? commands.slice(15 * i, 15 * i + 3) : [0, 0, 0];
    const command = `${vx.toFixed(2)} ${vy.toFixed(2)} ${yaw.toFixed(2)}`;
    const [x, y] = robot.position.map((value) => value.toFixed(2));
    const cells = [i + 1, x, y, command, passed[i] ? 'yes' : 'no'];
    element('robots').rows[i + 1].replaceChildren(
      ...cells.map((cell) => Object.assign(document.createElement('td'), { textContent: cell })),
    );
  });
  const successes = results.filter((result) => result === 'success').length;
  element('results').textContent = `${successes} of ${results.length}`;
  element('last').textContent = results.at(-1) ?? '';
}

function start(episode) {
  episode.reset(page.seed);
  element('seed').textContent = page.seed;
  page.seed += 1;
}

async function play({ episode, drawing }) {
  let last = performance.now();
  let due = 0; // s of simulation still to be done
  let wait = 0; // s until the next episode
  start(episode);
  const frame = async (now) => {
    const passed = (now - last) / 1000;
    last = now;
    if (page.playing && episode.result !== null) {
      wait -= passed * page.speed;
      if (wait < 0) start(episode);
    } else if (page.playing) {
      due = Math.min(due + passed * page.speed, LONGEST_FRAME * page.speed);
      while (due > 0 && episode.result === null) {
        await episode.step();
        due -= episode.settings.dt;
      }
      if (episode.result !== null) {
        results.push(episode.result);
        wait = PAUSE_AFTER;
      }
    }
    const { mujoco, model, data } = episode.physics;
    mujoco.mj_kinematics(model, data);
    drawing.draw(data);
    show(episode);
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

element('pause').addEventListener('click', () => {
  page.playing = !page.playing;
  element('pause').textContent = page.playing ? 'Pause' : 'Continue';
});
element('speed').addEventListener('change', (event) => (page.speed = Number(event.target.value)));
element('speed').value = String(page.speed);

try {
  const loaded = await load();
  element('next').addEventListener('click', () => start(loaded.episode));
  element('status').textContent = '';
  await play(loaded);
} catch (error) {
  const help = '`make docs` fetches the libraries and exports the policy; serve the site over HTTP.';
  element('status').textContent = `Not loaded (${error.message}). ${help}`;
  throw error;
}
