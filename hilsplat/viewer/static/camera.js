// The camera, with OpenCV axes (x right, y down, z forward). The rows of R are its axes in the world.

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const norm = (a) => Math.hypot(a[0], a[1], a[2]);
export const unit = (a) => { const n = norm(a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };

// Rotate v about the unit axis k (Rodrigues).
export function turned(v, k, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), x = cross(k, v), d = dot(k, v) * (1 - c);
  return [v[0] * c + x[0] * s + k[0] * d, v[1] * c + x[1] * s + k[1] * d, v[2] * c + x[2] * s + k[2] * d];
}

const FARTHEST = 20;   // in multiples of the photographs' mean distance; from there, the scene covers a few pixels

export class Camera {
  constructor(scene) {
    this.up = scene.up;
    this.reach = scene.reach;
    this.focus = scene.focus;
    this.view = 0;        // number of the photograph with its pose, or -1
    this.first = Math.max(0, scene.views.findIndex((view) => view.split === "train"));
    this.standAt(scene.views[this.first], this.first);
  }

  // Use the pose and lens of a photograph.
  standAt(view, number) {
    const m = view.cam_from_world, t = [m[0][3], m[1][3], m[2][3]];
    this.R = [0, 1, 2].map((row) => m[row].slice(0, 3));
    this.c = [0, 1, 2].map((k) => -(this.R[0][k] * t[0] + this.R[1][k] * t[1] + this.R[2][k] * t[2]));
    this.lens = { fx: view.K[0][0], fy: view.K[1][1], cx: view.K[0][2], cy: view.K[1][2], w: view.size_hw[1], h: view.size_hw[0] };
    this.aimAhead();
    this.view = number;
  }

  // Return the camera of a photograph.
  ofView(view, number = -1) {
    const next = this.copy();
    next.standAt(view, number);
    return next;
  }

  // Return the centre, and the corners of the picture at a depth.
  corners(depth) {
    const { fx, fy, cx, cy, w, h } = this.lens;
    const corner = ([u, v]) => [(u - cx) / fx, (v - cy) / fy, 1].reduce((at, value, axis) => add(at, this.R[axis], depth * value), this.c);
    return [this.c, ...[[0, 0], [w, 0], [w, h], [0, h]].map(corner)];
  }

  // Orbit about the point ahead that is nearest to the cameras' focus.
  aimAhead() {
    const ahead = dot(add(this.focus, this.c, -1), this.R[2]);
    this.target = add(this.c, this.R[2], ahead > 0.05 * this.reach ? ahead : this.reach);
  }

  turn(axis, angle) {
    this.c = add(this.target, turned(add(this.c, this.target, -1), axis, angle));
    this.R = this.R.map((row) => turned(row, axis, angle));
    this.tidy();
    this.view = -1;
  }

  orbit(dx, dy) {
    this.turn(this.up, dx);
    const height = Math.asin(Math.max(-1, Math.min(1, -dot(this.R[2], this.up))));
    const wanted = Math.max(-1.5, Math.min(1.5, height + dy));
    this.turn(this.R[0], height - wanted);
  }

  zoom(factor) {
    const away = add(this.c, this.target, -1), far = norm(away) * factor;
    this.c = add(this.target, unit(away), Math.min(Math.max(far, 1e-3 * this.reach), FARTHEST * this.reach));
    this.view = -1;
  }

  // Move along the camera's axes, by fractions of the distance to the target.
  move(x, y, z) {
    const far = norm(add(this.c, this.target, -1));
    for (const [axis, by] of [[0, x], [1, y], [2, z]]) {
      this.c = add(this.c, this.R[axis], by * far);
      this.target = add(this.target, this.R[axis], by * far);
    }
    this.view = -1;
  }

  // Return a camera that shows a ball of the given diameter around a point, from the same side.
  lookingAt(point, size) {
    const next = this.copy(), { fx, fy, w, h } = this.lens;
    const back = Math.max(size * (0.5 + Math.max(fx / w, fy / h)), 0.02 * this.reach);   // the front of the ball is nearer than its centre
    next.target = point.slice();
    next.c = add(point, this.R[2], -back);
    next.view = -1;
    return next;
  }

  tidy() {   // keep the axes orthogonal in spite of rounding
    this.R[2] = unit(this.R[2]);
    this.R[0] = unit(add(this.R[0], this.R[2], -dot(this.R[0], this.R[2])));
    this.R[1] = cross(this.R[2], this.R[0]);
  }

  copy() {
    const next = Object.create(Camera.prototype);
    return Object.assign(next, this, { R: this.R.map((r) => r.slice()), c: this.c.slice(), target: this.target.slice(), lens: { ...this.lens } });
  }

  // Interpolate between two cameras, t in [0, 1]; the interpolated axes are made orthogonal.
  between(to, t) {
    const next = to.copy(), mix = (a, b) => a.map((v, k) => v + t * (b[k] - v));
    next.c = mix(this.c, to.c);
    next.target = mix(this.target, to.target);
    next.R = this.R.map((row, k) => mix(row, to.R[k]));
    if (norm(next.R[2]) < 1e-3 || norm(next.R[0]) < 1e-3) next.R = to.R.map((r) => r.slice());
    next.tidy();
    for (const key of Object.keys(this.lens)) next.lens[key] = this.lens[key] + t * (to.lens[key] - this.lens[key]);
    if (t < 1) next.view = -1;
    return next;
  }

  // Position of the photograph's frame in a canvas, scaled to fit and centred.
  frame(width, height) {
    const s = Math.min(width / this.lens.w, height / this.lens.h);
    return { s, x: (width - s * this.lens.w) / 2, y: (height - s * this.lens.h) / 2 };
  }

  intrinsics(width, height) {
    const { s, x, y } = this.frame(width, height), l = this.lens;
    return { fx: s * l.fx, fy: s * l.fy, cx: s * l.cx + x, cy: s * l.cy + y };
  }

  get translation() { return this.R.map((row) => -dot(row, this.c)); }

  project(point, k) {
    const d = add(point, this.c, -1), z = dot(this.R[2], d);
    return z < 0.01 ? null : [k.fx * dot(this.R[0], d) / z + k.cx, k.fy * dot(this.R[1], d) / z + k.cy];
  }

  // Format of the server's requests.
  wire(width, height) {
    const k = this.intrinsics(width, height), t = this.translation;
    return {
      cam_from_world: [...this.R.map((row, i) => [...row, t[i]]), [0, 0, 0, 1]],
      K: [[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]],
      size_hw: [Math.round(height), Math.round(width)],
    };
  }

  // Format of the address: the number of a photograph, or numbers that restore the camera.
  toText() {
    if (this.view >= 0) return `v${this.view}`;
    const l = this.lens, short = (v) => +v.toPrecision(6);
    return [...this.R[0], ...this.R[2], ...this.c, ...this.target, l.fx, l.fy, l.cx, l.cy, l.w, l.h].map(short).join(",");
  }

  fromText(text, views) {
    if (/^v\d+$/.test(text) && views[+text.slice(1)]) return this.standAt(views[+text.slice(1)], +text.slice(1));
    const n = text.split(",").map(Number);
    if (n.length !== 18 || !n.every(Number.isFinite)) return;
    const R = [n.slice(0, 3), [0, 0, 0], n.slice(3, 6)];
    if (norm(R[0]) < 0.5 || norm(R[2]) < 0.5 || Math.min(n[12], n[13], n[16], n[17]) <= 0) return;
    Object.assign(this, { R, c: n.slice(6, 9), target: n.slice(9, 12), view: -1 });
    this.lens = { fx: n[12], fy: n[13], cx: n[14], cy: n[15], w: n[16], h: n[17] };
    this.tidy();
  }
}
