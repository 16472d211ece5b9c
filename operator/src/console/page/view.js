// The camera: where it looks from, what a point becomes on the screen, and back.

import { add, along, clamp, cross, dot, multiply, perspective, scale, sub, transform, unit } from "./math.js";

const FOV = 0.62;

export class View {
  constructor() {
    this.target = [0.25, 0, 0.38];
    this.azimuth = -0.85;
    this.elevation = 0.32;
    this.distance = 1.95;
    this.width = this.height = 1;
    this.update();
  }

  resize(width, height) {
    [this.width, this.height] = [Math.max(1, width), Math.max(1, height)];
    this.update();
  }

  orbit(dx, dy) {
    this.azimuth -= dx;
    this.elevation = clamp(this.elevation + dy, -0.15, 1.45);
    this.update();
  }

  zoom(factor) {
    this.distance = clamp(this.distance * factor, 0.6, 6);
    this.update();
  }

  update() {
    const [ce, se] = [Math.cos(this.elevation), Math.sin(this.elevation)];
    const out = [ce * Math.cos(this.azimuth), ce * Math.sin(this.azimuth), se];
    // A narrow picture steps back, so that the arm stays within it.
    const aspect = this.width / this.height;
    const distance = this.distance * Math.max(1, 0.95 / aspect);
    this.eye = along(this.target, out, distance);
    this.forward = scale(out, -1);
    this.right = unit(cross(this.forward, [0, 0, 1]));
    this.up = cross(this.right, this.forward);
    const [r, u, b, e] = [this.right, this.up, out, this.eye];
    const look = new Float32Array([
      r[0], u[0], b[0], 0, r[1], u[1], b[1], 0, r[2], u[2], b[2], 0, -dot(r, e), -dot(u, e), -dot(b, e), 1,
    ]);
    this.matrix = multiply(perspective(FOV, aspect, 0.05, 30), look);
  }

  /** CSS pixels of a point, and how far in front of the eye it is. */
  project(p) {
    const [x, y, , w] = transform(this.matrix, p);
    return { x: (x / w + 1) * 0.5 * this.width, y: (1 - y / w) * 0.5 * this.height, depth: w };
  }

  /** Metres per CSS pixel at the depth of `p`. */
  metresPerPixel(p) {
    return (2 * Math.tan(FOV / 2) * dot(sub(p, this.eye), this.forward)) / this.height;
  }

  /** What a movement of the pointer by so many pixels is in the plane through `p` that faces the camera. */
  drag(p, dx, dy) {
    const m = this.metresPerPixel(p);
    return add(scale(this.right, dx * m), scale(this.up, -dy * m));
  }
}
