// The camera of a drawing: it shows the action, the whole scene, or one robot; the reader turns it and zooms.
import * as three from 'three';
import { OrbitControls } from './lib/OrbitControls.js';

const BESIDE = [-0.45, -1, 0.9]; // direction of the camera from its target, with the x axis to the right
const BEHIND_START = [-1, -0.25, 0.9]; // with the x axis upwards
const STEEP = 1.2; // m above the robot that it follows per m behind it, so that no robot hides its ball
const AHEAD = 2.5; // m in front of that robot
const [ROBOTS_WITHIN, OBJECTS_WITHIN] = [4, 12]; // m from that robot, within which the picture has them
const [SMOOTH, TURN] = [0.12, 0.3]; // s, of the camera that follows a robot
const [MOVE, RETREAT, APPROACH] = [0.3, 0.2, 1.5]; // s, of the camera that shows the action
const NEAREST = 2.5; // m, their distance at least
const ROBOT = 0.42; // m, radius about a trunk that the picture contains
const NEAR_GOAL = 3; // m from the goal next to the objects within which points belong to that goal
const ROOM = 1.07; // factor of the distance at which the points would reach the picture's edges

const point = (values, index) => new three.Vector3(...values.slice(3 * index, 3 * index + 3));
const diameter = (box) => box.getSize(new three.Vector3()).length();

export class Camera {
  constructor(canvas) {
    this.lens = new three.PerspectiveCamera(40, 1, 0.1, 120);
    this.lens.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.lens, canvas);
    this.controls.maxPolarAngle = 1.5;
    this.look('');
  }

  /** Looks at a model; `boxes` are pairs of a body and the extent of one of its geoms, `settings` those of `scene.json`. */
  show(model, boxes, settings) {
    const { track, robots } = settings;
    Object.assign(this, { boxes, track });
    this.addresses = robots.map(({ base_qpos: addresses }) => addresses);
    const joints = [...model.jnt_bodyid.keys()];
    this.robots = this.addresses.map(([first]) => model.jnt_bodyid[joints.find((i) => model.jnt_qposadr[i] === first)]);
    const sliding = joints.filter((i) => [0, 2].includes(model.jnt_type[i])).map((i) => model.jnt_bodyid[i]);
    const radius = (body) => Math.max(0, ...boxes.map(([owner, box]) => (owner === body ? diameter(box) / 2 : 0)));
    this.objects = [...new Set(sliding)].filter((body) => !this.robots.includes(body));
    this.objects = this.objects.map((body) => [body, radius(body)]);
    this.sites = [...Array(model.nsite).keys()]; // of the goals
    this.look(this.view);
  }

  /** Shows the action (''), the whole scene ('scene') or a robot, given by its number. */
  look(view) {
    Object.assign(this, { view, fresh: true });
    this.jump();
  }

  /** Moves to the right place at once with the next picture, as bodies have moved. */
  jump() {
    this.jumps = true;
  }

  /** Fits the picture to the part of the canvas that is not covered by controls; an open menu does not count. */
  resize(width, height, above, below) {
    const bar = Math.min(above, height / 4);
    const free = height - bar - Math.min(below, height / 2);
    this.lens.aspect = width / free;
    this.lens.setViewOffset(width, free, 0, -bar, width, height);
    if (!/\d/.test(this.view)) this.look(this.view);
  }

  /** Moves for the next picture, `seconds` after the last one. */
  update(data, seconds) {
    const share = (time) => (this.jumps ? 1 : 1 - Math.exp(-seconds / time));
    if (this.view === '') this.showAction(data, share);
    else if (this.view !== 'scene') this.chase(data, share);
    else if (this.fresh) this.showScene(data);
    this.fresh = this.jumps = false;
    this.controls.update();
  }

  /** Keeps robots, objects and the goal in the picture. */
  showAction({ xpos, site_xpos }, share) {
    const { controls, lens } = this;
    const objects = this.objectSpheres(xpos);
    const goals = nextTo(this.sites.map((site) => point(site_xpos, site)), objects).map((place) => [place, 0]);
    const spheres = [...this.robots.map((body) => [point(xpos, body), ROBOT]), ...objects, ...goals];
    const offset = lens.position.clone().sub(controls.target);
    const direction = this.fresh ? this.direction() : offset.clone().normalize();
    const zoom = this.fresh ? 1 : offset.length() / this.distance; // the reader's
    const [target, needed] = this.fitted(spheres, direction);
    this.approach(needed, share);
    this.place(controls.target.clone().lerp(target, share(MOVE)), direction, zoom * this.distance);
  }

  /** Shows all of the scene within the track. */
  showScene({ xpos, xquat }) {
    const { start, length, width } = this.track;
    const box = new three.Box3();
    for (const [body, extent] of this.boxes) {
      const [w, x, y, z] = xquat.slice(4 * body, 4 * body + 4);
      const pose = new three.Matrix4().makeRotationFromQuaternion(new three.Quaternion(x, y, z, w));
      box.union(extent.clone().applyMatrix4(pose.setPosition(point(xpos, body))));
    }
    box.min.max(new three.Vector3(start, -width / 2, 0));
    box.max.min(new three.Vector3(start + length, width / 2, 2));
    const { min, max } = box;
    const corners = [min, max].flatMap(({ x }) => [min, max].flatMap(({ y }) => [min, max].map(({ z }) => [x, y, z])));
    const direction = this.direction();
    const spheres = corners.map((corner) => [new three.Vector3(...corner), 0]);
    const [target, distance] = this.fitted(spheres, direction);
    this.place(target, direction, distance);
  }

  /** Stays behind and above the robot that it follows, with objects and robots around it in the picture. */
  chase({ qpos, xpos }, share) {
    const [x, y, z, w, i, j, k] = this.addresses[this.view].map((address) => qpos[address]);
    const yaw = Math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k));
    const own = new three.Vector3(x, y, z);
    const forward = new three.Vector3(Math.cos(yaw), Math.sin(yaw), 0);
    const within = (spheres, most) => spheres.filter(([place, radius]) => place.distanceTo(own) - radius < most);
    const robots = this.robots.map((body) => [point(xpos, body), ROBOT]);
    const near = [...within(robots, ROBOTS_WITHIN), ...within(this.objectSpheres(xpos), OBJECTS_WITHIN)];
    this.heading = this.jumps ? forward : this.heading.lerp(forward, share(TURN));
    const direction = new three.Vector3(-this.heading.x, -this.heading.y, STEEP).normalize();
    const [target, needed] = this.fitted([[own.clone().addScaledVector(forward, AHEAD), 0], ...near], direction);
    this.approach(needed, share);
    this.place(this.controls.target.clone().lerp(target, share(SMOOTH)), direction, this.distance);
  }

  /** Changes the distance smoothly to one that is needed, outwards faster than inwards. */
  approach(needed, share) {
    const change = Math.max(NEAREST, needed) - (this.distance ?? 0);
    this.distance = (this.distance ?? 0) + change * share(change > 0 ? RETREAT : APPROACH);
  }

  objectSpheres(xpos) {
    return this.objects.map(([body, radius]) => [point(xpos, body), radius]);
  }

  /** The direction from the target to the camera in which the longer side of the track is along that of the picture. */
  direction() {
    const long = this.track.length > 1.1 * this.track.width;
    return new three.Vector3(...(long === this.lens.aspect > 1 ? BESIDE : BEHIND_START)).normalize();
  }

  place(target, direction, distance) {
    this.controls.target.copy(target);
    this.lens.position.copy(target).addScaledVector(direction, distance);
  }

  /** Target and distance with which the picture contains and centres spheres, pairs of a place and a radius, m. */
  fitted(spheres, direction) {
    const { aspect, fov } = this.lens;
    const tangent = Math.tan((fov * Math.PI) / 360);
    const forward = direction.clone().negate();
    const right = new three.Vector3().crossVectors(forward, this.lens.up).normalize();
    const up = new three.Vector3().crossVectors(right, forward);
    const target = new three.Box3().setFromPoints(spheres.map(([place]) => place)).getCenter(new three.Vector3());
    let distance = 0;
    for (let i = 0; i < 10; i++) {
      const seen = spheres.map(([place, radius]) => {
        const offset = place.clone().sub(target);
        return [offset.dot(right), offset.dot(up), offset.dot(forward), radius];
      });
      const need = ([x, y, z, r]) => Math.max((Math.abs(x) + r) / aspect, Math.abs(y) + r) / tangent - z;
      distance = Math.max(...seen.map(need));
      for (const [k, axis] of [right, up].entries()) {
        const edges = seen.flatMap((one) => [-1, 1].map((side) => (one[k] + side * one[3]) / (distance + one[2])));
        target.addScaledVector(axis, (distance * (Math.max(...edges) + Math.min(...edges))) / 4);
      }
    }
    return [target, ROOM * distance];
  }

  dispose() {
    this.controls.dispose();
  }
}

/** The places of the goal that is next to the objects, or all places without objects. */
function nextTo(places, objects) {
  if (!places.length || !objects.length) return places;
  const middle = objects.reduce((sum, [place]) => sum.add(place), new three.Vector3()).divideScalar(objects.length);
  const closest = places.reduce((a, b) => (a.distanceTo(middle) < b.distanceTo(middle) ? a : b));
  return places.filter((place) => place.distanceTo(closest) < NEAR_GOAL);
}
