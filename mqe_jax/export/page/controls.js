// Keys and touch pads that drive a robot: values in [-1, 1] by command.
const KEYS = {
  KeyW: ['vx', 1],
  ArrowUp: ['vx', 1],
  KeyS: ['vx', -1],
  ArrowDown: ['vx', -1],
  KeyQ: ['vy', 1],
  KeyE: ['vy', -1],
  KeyA: ['yaw_rate', 1],
  ArrowLeft: ['yaw_rate', 1],
  KeyD: ['yaw_rate', -1],
  ArrowRight: ['yaw_rate', -1],
};

export class Controls {
  /**
   * @param pads elements whose data attributes `x` and `y` name the commands of their axes.
   * @param onMove called at the first movement of keys or pads.
   */
  constructor(pads, onMove) {
    this.pressed = new Set();
    this.pad = {};
    this.onMove = onMove;
    addEventListener('keydown', (event) => {
      const typing = event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === 'SELECT';
      if (!(event.code in KEYS) || typing) return;
      event.preventDefault();
      this.pressed.add(event.code);
      this.onMove();
    });
    addEventListener('keyup', (event) => this.pressed.delete(event.code));
    addEventListener('blur', () => this.pressed.clear());
    pads.forEach((pad) => this.listen(pad));
  }

  /** Drags in a pad set the commands of its axes, up and left positive as seen by the robot. */
  listen(pad) {
    const knob = pad.firstElementChild;
    const set = (x, y) => {
      if (pad.dataset.x) this.pad[pad.dataset.x] = -x;
      if (pad.dataset.y) this.pad[pad.dataset.y] = -y;
      knob.style.transform = `translate(${40 * (pad.dataset.x ? x : 0)}px, ${40 * (pad.dataset.y ? y : 0)}px)`;
    };
    const move = (event) => {
      if (!pad.hasPointerCapture(event.pointerId)) return;
      const { left, top, width, height } = pad.getBoundingClientRect();
      const within = (value) => Math.max(-1, Math.min(1, value));
      set(within((2 * (event.clientX - left)) / width - 1), within((2 * (event.clientY - top)) / height - 1));
      this.onMove();
    };
    pad.addEventListener('pointerdown', (event) => {
      pad.setPointerCapture(event.pointerId);
      move(event);
    });
    pad.addEventListener('pointermove', move);
    for (const end of ['pointerup', 'pointercancel']) pad.addEventListener(end, () => set(0, 0));
  }

  /** The values of commands, zero for those that neither keys nor pads set; `skill` is that of the command `skill`. */
  values(commands, skill) {
    const keys = {};
    for (const code of this.pressed) keys[KEYS[code][0]] = (keys[KEYS[code][0]] ?? 0) + KEYS[code][1];
    const value = (name) => (name === 'skill' ? skill : (keys[name] ?? 0) + (this.pad[name] ?? 0));
    return commands.map((name) => Math.max(-1, Math.min(1, value(name))));
  }
}
