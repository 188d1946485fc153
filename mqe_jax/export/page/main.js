// The page: loads a site of `mqe play-site`, plays its episodes, and lets the reader choose and drive.
import { Controls } from './controls.js';
import { Drawing, drawsInSoftware } from './drawing.js';
import { Site } from './episode.js';

const PAUSE_AFTER = 2.5; // s of page time between two episodes
const LONGEST_WORK = 40; // ms of simulation at most before a frame, so that a slow browser stays responsive
const LONGEST_SKIP = 70; // ms without a new picture at most, where the simulation is behind
const SLOW = 20; // frames per second below which the page changes to low detail
const NAMED = 4; // robots of a team, at most, that are named one by one above the picture
const REASONS = { fall: 'a robot fell', collision: 'a collision', rule: '', time: 'time is up' };

const element = (id) => document.getElementById(id);
const make = (tag, properties) => Object.assign(document.createElement(tag), properties);
const options = new URLSearchParams(location.search);
const page = {
  playing: true,
  seed: Math.round(Number(options.get('seed') ?? 0)) || 0,
  drive: options.get('drive') ?? '',
  skill: options.get('skill') ?? '',
  view: options.get('view') ?? '',
  speed: options.get('speed') ?? '1',
  detail: options.get('detail') ?? 'auto',
  wait: 0, // s until the next episode
  due: 0, // s of simulation still to be done
  asked: [], // what the reader asked for, done between two frames, as an environment step must not be interrupted
  scores: { episodes: 0, success: 0, wins: [0, 0] },
};
let site, episode, drawing, controls;
let shown = ''; // the score that is written

const later = (work) => page.asked.push(work);

async function read(name) {
  const response = await fetch(name);
  if (!response.ok) throw new Error(`${name}: ${response.status} ${response.statusText}`);
  return new Uint8Array(await response.arrayBuffer());
}

/** Shows the state of the page in its address, so that a reload or a sent link continues here. */
function remember() {
  const shown = { task: element('task').value, seed: page.seed };
  episode.names.forEach((name, team) => (shown[`team${team}`] = name));
  for (const key of ['drive', 'skill', 'view']) if (page[key] !== '') shown[key] = page[key];
  if (page.speed !== '1') shown.speed = page.speed;
  if (page.detail !== 'auto') shown.detail = page.detail;
  history.replaceState(null, '', `?${new URLSearchParams(shown)}`);
}

function fill(select, entries, value) {
  select.replaceChildren(...entries.map(([key, text]) => make('option', { value: key, textContent: text })));
  select.value = value;
}

const isMatch = () => episode.settings.teams.length > 1;
const hex = ([r, g, b]) => `rgb(${255 * r} ${255 * g} ${255 * b})`;

function dot(robot) {
  const mark = make('span', { className: 'dot' });
  mark.style.background = hex(episode.settings.robots[robot].color);
  return mark;
}

/** The dots of robots, one of each colour. */
function dots(robots) {
  const colors = robots.map((robot) => hex(episode.settings.robots[robot].color));
  return robots.filter((_, i) => colors.indexOf(colors[i]) === i).map(dot);
}

/** Loads a task with the policies of the address, and starts an episode. */
async function load(name, chosen) {
  const fresh = await site.episode(name);
  for (const team of fresh.settings.teams.keys()) {
    const policy = chosen.get(`team${team}`);
    if (policy !== null) await fresh.choose(team, policy);
  }
  episode?.delete();
  episode = fresh;
  const { settings } = episode;
  document.title = `${settings.title} - mqe_jax`;
  drawing.show(episode.physics.model, settings);
  const robots = settings.robots.map((_, i) => [String(i), `robot ${i + 1}`]);
  const agents = robots.slice(0, settings.teams.flat().length);
  if (page.drive !== '' && !(Number(page.drive) < agents.length)) page.drive = '';
  if (page.view !== 'scene' && !(Number(page.view) < robots.length)) page.view = '';
  const { skills } = settings;
  if (!skills.includes(page.skill)) page.skill = '';
  fill(element('skill'), skills.map((skill) => [skill, skill]), page.skill || skills.at(-1));
  element('skill').parentElement.hidden = skills.length < 2;
  fill(element('drive'), [['', 'nobody'], ...agents], page.drive);
  fill(element('view'), [['', 'action'], ['scene', 'whole scene'], ...robots], page.view);
  element('aim').textContent = settings.aim;
  element('teams').replaceChildren(...settings.teams.map((_, team) => teamChoice(team)));
  setDrive(page.drive);
  setView(page.view);
  start();
}

/** The choice of a team's policy. */
function teamChoice(team) {
  const { settings, names } = episode;
  const row = make('label', {});
  const text = make('span', {});
  text.append(...dots(settings.teams[team]), isMatch() ? `Team ${team + 1}` : 'Policy');
  const select = make('select', { id: `team${team}` });
  const known = [...settings.policies.map(({ name }) => name), 'idle'];
  fill(select, known.map((name) => [name, name]), names[team]);
  select.addEventListener('change', () =>
    later(async () => {
      await episode.choose(team, select.value);
      restartScores();
      start();
    }),
  );
  row.append(text, select);
  return row;
}

function restartScores() {
  page.scores = { episodes: 0, success: 0, wins: [0, 0] };
}

/** Starts the episode of the page's seed. */
function start() {
  episode.reset(page.seed);
  page.due = 0;
  drawing.camera.jump();
  element('result').hidden = true;
  remember();
  show();
}

function advance() {
  page.seed += 1;
  start();
}

/** Lets the reader drive a robot, or nobody (''). */
function setDrive(robot) {
  page.drive = robot;
  element('drive').value = robot;
  episode.driven.fill(0);
  if (robot !== '') episode.driven[Number(robot)] = 1;
  const touch = matchMedia('(pointer: coarse)').matches;
  for (const id of ['walk', 'turn']) element(id).hidden = !touch;
  const one = robotToDrive();
  element('take').replaceChildren(...(robot === '' ? ['Drive ', dot(Number(one)), `robot ${Number(one) + 1}`] : ['Stop driving']));
  element('free').hidden = robot !== '' || touch;
  element('driving').hidden = robot === '' || touch;
  element('guide').hidden = false;
  shown = '';
}

/** The robot that the camera follows, if the reader can drive it, else the first. */
const robotToDrive = () => (/\d/.test(page.view) && Number(page.view) < episode.driven.length ? page.view : '0');

/** Lets the reader drive the robot of the button from the start of an episode, or gives the robot back. */
function driveOrStop() {
  const robot = page.drive === '' ? robotToDrive() : '';
  setDrive(robot);
  setView(robot);
  if (robot !== '') later(start);
  remember();
}

function setView(view) {
  page.view = view;
  element('view').value = view;
  drawing.camera.look(view);
}

/** The first key or touch that drives takes over the first robot, or the one that the camera follows. */
function takeOver() {
  if (page.drive !== '' || !episode) return;
  const robot = robotToDrive();
  setDrive(robot);
  setView(robot);
  remember();
}

/** Says how an episode ended, and counts it. */
function finish() {
  const { outcome, result, settings } = episode;
  const { scores } = page;
  const said = element('result');
  scores.episodes += 1;
  const reason = REASONS[result] && ` (${REASONS[result]})`;
  if (isMatch()) {
    const winner = settings.teams.findIndex((_, team) => outcome[`team${team}/win`] > 0.5);
    if (winner >= 0) scores.wins[winner] += 1;
    const [marks, name] = winner < 0 ? [[], ''] : [dots(settings.teams[winner]), `Team ${winner + 1} wins`];
    const own = winner >= 0 && page.drive !== '' && (isOwn(settings.teams[winner]) ? 'You win' : 'You lose');
    said.replaceChildren(...marks, (own || name || 'Draw') + reason);
  } else {
    const { success } = outcome;
    scores.success += success;
    const text = success >= 1 ? 'Success' : success > 0 ? `${Math.round(100 * success)}% success` : 'No success';
    said.replaceChildren(text + (success >= 1 ? '' : reason));
  }
  said.hidden = false;
  page.wait = PAUSE_AFTER;
}

const isOwn = (team) => page.drive !== '' && team.includes(Number(page.drive));

/** Writes the clock, and who is who with the score. */
function show() {
  const { settings, steps, outcome } = episode;
  const limit = settings.max_steps * settings.dt;
  element('clock').textContent = `${(steps * settings.dt).toFixed(1)} / ${limit.toFixed(0)} s`;
  const { episodes, success, wins } = page.scores;
  const percent = (share) => `${Math.round(100 * share)}%`;
  const mean = episodes ? `, mean of ${episodes}: ${percent(success / episodes)}` : '';
  const score = isMatch() ? `${wins[0]} : ${wins[1]}` : `success ${percent(outcome.success)}${mean}`;
  if (score === shown) return;
  shown = score;
  const named = (robots, name) => {
    const label = make('span', { className: 'who' });
    label.append(...dots(robots), isOwn(robots) ? `${name} (you)` : name);
    return label;
  };
  const { teams, robots } = settings;
  const agents = teams.flat();
  const scripted = robots.map((_, i) => i).slice(agents.length);
  const mates = agents.length > NAMED
    ? [named(agents, `${agents.length} robots`)]
    : agents.map((i) => named([i], `robot ${i + 1}`));
  const sides = isMatch()
    ? teams.map((team, i) => named(team, `team ${i + 1}`))
    : [...mates, ...scripted.map((i) => named([i], 'scripted'))];
  element('score').replaceChildren(...(isMatch() ? [sides[0], score, sides[1]] : [...sides, score]));
}

/** Draws with the detail that the page asks for; `low` replaces the canvas, since a context keeps its settings. */
function setDetail(low) {
  const old = element('canvas');
  const canvas = drawing ? old.cloneNode() : old;
  drawing?.dispose();
  old.replaceWith(canvas);
  drawing = new Drawing(canvas, low);
  if (!episode) return;
  drawing.show(episode.physics.model, episode.settings);
  setView(page.view);
}

const wantsLow = () => (page.detail === 'auto' ? drawsInSoftware() : page.detail === 'low');

/** Measures frames and simulated time per second. */
class Meter {
  constructor() {
    Object.assign(this, { frames: 0, steps: 0, since: performance.now() });
  }

  update() {
    const seconds = (performance.now() - this.since) / 1000;
    if (seconds < 2) return;
    const [rate, pace] = [this.frames / seconds, (this.steps * episode.settings.dt) / seconds];
    Object.assign(document.body.dataset, { rate: rate.toFixed(1), pace: pace.toFixed(2), low: drawing.low });
    const detail = drawing.low ? 'low' : 'high';
    const version = site.mujoco.mj_versionString();
    element('about').textContent =
      `${rate.toFixed(0)} frames per second in ${detail} detail, ${pace.toFixed(1)} x real time, MuJoCo ${version}.`;
    Object.assign(this, new Meter());
    if (rate < SLOW && page.detail === 'auto' && !drawing.low && !document.hidden) setDetail(true);
  }
}

/** Steps the episode as far as page time has advanced; returns the number of steps. */
async function simulate(passed) {
  const { dt, commands, skills } = episode.settings;
  const skill = (2 * element('skill').selectedIndex + 1) / skills.length - 1; // the middle of its part of the range
  const speed = Number(page.speed);
  page.due = Math.min(page.due + passed * speed, 5 * dt * Math.max(1, speed));
  const until = performance.now() + LONGEST_WORK;
  let steps = 0;
  while (page.due >= dt && episode.result === null && performance.now() < until) {
    if (page.drive !== '') episode.drive.set(controls.values(commands, skill), commands.length * Number(page.drive));
    await episode.step();
    page.due -= dt;
    steps += 1;
  }
  return steps;
}

/** Heights of the upper and the lower part of the canvas that controls cover, pixels. */
function covered() {
  const controls = ['guide', 'walk'].map(element).filter(({ hidden }) => !hidden);
  const top = Math.min(innerHeight, ...controls.map((item) => item.offsetTop));
  return [element('bar').offsetHeight, innerHeight - top];
}

function play() {
  const meter = new Meter();
  let [last, drawn] = [performance.now(), 0];
  const frame = async (now) => {
    const passed = Math.max(0, Math.min((now - last) / 1000, 0.25));
    last = now;
    for (const work of page.asked.splice(0)) await work();
    if (page.playing && episode.result !== null) {
      page.wait -= passed;
      if (page.wait < 0) advance();
    } else if (page.playing) {
      meter.steps += await simulate(passed);
      if (episode.result !== null) finish();
    }
    const behind = page.due >= episode.settings.dt && episode.result === null;
    if (!behind || now - drawn > LONGEST_SKIP) {
      drawing.draw(episode.physics.data, (now - drawn) / 1000, ...covered());
      show();
      drawn = now;
      meter.frames += 1;
    }
    meter.update();
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

function pause() {
  page.playing = !page.playing;
  element('pause').textContent = page.playing ? 'Pause' : 'Continue';
}

function setSpeed(speed) {
  page.speed = speed;
  element('speed').value = speed;
  remember();
}

function listen() {
  for (const button of document.querySelectorAll('button')) button.addEventListener('click', () => button.blur()); // keys drive
  element('take').addEventListener('click', driveOrStop);
  element('pause').addEventListener('click', pause);
  element('restart').addEventListener('click', () => later(start));
  element('next').addEventListener('click', () => later(advance));
  element('skill').addEventListener('change', ({ target }) => {
    page.skill = target.value;
    remember();
  });
  element('drive').addEventListener('change', ({ target }) => {
    setDrive(target.value);
    setView(target.value);
    remember();
  });
  element('view').addEventListener('change', ({ target }) => (setView(target.value), remember()));
  element('speed').addEventListener('change', ({ target }) => setSpeed(target.value));
  element('detail').addEventListener('change', ({ target }) => {
    page.detail = target.value;
    later(() => setDetail(wantsLow()));
    remember();
  });
  element('share').addEventListener('click', async () => {
    remember();
    await navigator.clipboard?.writeText(location.href);
    element('share').textContent = navigator.clipboard ? 'Copied' : 'Copy the address';
  });
  element('task').addEventListener('change', ({ target }) => {
    element('status').textContent = 'Loading…';
    later(async () => {
      Object.assign(page, { drive: '', view: '' });
      restartScores();
      await load(target.value, new URLSearchParams());
      element('status').textContent = '';
    });
  });
  const views = () => ['', 'scene', ...episode.settings.robots.map((_, i) => String(i))];
  const keys = {
    Space: pause,
    KeyR: () => later(start),
    KeyN: () => later(advance),
    KeyT: () => setSpeed(page.speed === '0.25' ? '1' : '0.25'),
    KeyC: () => (setView(views()[(views().indexOf(page.view) + 1) % views().length]), remember()),
  };
  addEventListener('keydown', (event) => {
    const elsewhere = event.ctrlKey || event.metaKey || /SELECT|BUTTON|SUMMARY/.test(event.target.tagName);
    if (!(event.code in keys) || elsewhere) return;
    event.preventDefault();
    keys[event.code]();
  });
}

try {
  setDetail(wantsLow());
  const [{ default: loadMujoco }, ort] = await Promise.all([
    import('./lib/mujoco.js'),
    import('./lib/ort.wasm.min.mjs'),
  ]);
  site = new Site(read, await loadMujoco(), ort);
  const { tasks } = await site.json('site.json');
  const asked = options.get('task');
  const first = tasks.some(({ name }) => name === asked) ? asked : tasks[0].name;
  fill(element('task'), tasks.map(({ name, title }) => [name, title]), first);
  element('speed').value = page.speed;
  element('detail').value = page.detail;
  await load(first, options);
  controls = new Controls([element('walk'), element('turn')], takeOver);
  listen();
  element('status').textContent = '';
  play();
} catch (error) {
  element('status').textContent = `Not loaded (${error.message}). Serve the folder over HTTP, see docs/play.md.`;
  throw error;
}
