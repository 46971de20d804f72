// A trackball about a point: turn, move, zoom, by pointer, wheel and keys; all panes share the one camera.
import { Matrix4, Quaternion, Vector3 } from "three";

const X = new Vector3(1, 0, 0);
const Y = new Vector3(0, 1, 0);
const Z = new Vector3(0, 0, 1);

export class Orbit {
  /** @param camera the shared camera @param changed called whenever the picture must be drawn again */
  constructor(camera, changed) {
    this.camera = camera;
    this.changed = changed;
    this.target = new Vector3();
    this.turned = new Quaternion();
    this.distance = 10;
    this.flight = null;
    this.pointers = new Map();
  }

  /** Turn about the screen's own axes by angles in radians. */
  turn(right, up) {
    const step = new Quaternion().setFromAxisAngle(Y, -right).multiply(new Quaternion().setFromAxisAngle(X, -up));
    this.turned.multiply(step).normalize();
    this.apply();
  }

  /** Roll about the line of sight. */
  roll(angle) {
    this.turned.multiply(new Quaternion().setFromAxisAngle(Z, angle)).normalize();
    this.apply();
  }

  /** Move the picture by pixels of a pane `height` pixels high. */
  move(right, down, height) {
    const scale = (2 * this.distance * Math.tan((this.camera.fov * Math.PI) / 360)) / height;
    const step = new Vector3(-right * scale, down * scale, 0).applyQuaternion(this.turned);
    this.target.add(step);
    this.apply();
  }

  /** Come nearer by a factor below one, go away by one above. */
  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 0.5), 2000);
    this.apply();
  }

  /** Look at a sphere from a direction given by the rows right, up, towards the eye; glide there. */
  look(axes, center, radius, aspect, glide = true) {
    const half = (this.camera.fov * Math.PI) / 360;
    this.go({ axes, center, distance: radius / Math.sin(half) / Math.min(1, aspect) }, glide);
  }

  /** How the camera stands: rows right, up, towards the eye; the point about which it turns; its distance from it. */
  get stand() {
    const { elements } = new Matrix4().makeRotationFromQuaternion(this.turned);
    return { axes: [0, 1, 2].flatMap((k) => elements.slice(4 * k, 4 * k + 3)), center: this.target.toArray(), distance: this.distance };
  }

  /** Bring the camera to a stand. */
  go({ axes, center, distance }, glide = true) {
    const matrix = new Matrix4().makeBasis(...[0, 3, 6].map((i) => new Vector3(...axes.slice(i, i + 3))));
    const to = { target: new Vector3(...center), turned: new Quaternion().setFromRotationMatrix(matrix), distance };
    if (glide && !matchMedia("(prefers-reduced-motion: reduce)").matches) this.fly(to);
    else this.jump(to);
  }

  jump(to) {
    this.flight = null;
    this.target.copy(to.target);
    this.turned.copy(to.turned);
    this.distance = to.distance;
    this.apply();
  }

  fly(to) {
    const from = { target: this.target.clone(), turned: this.turned.clone(), distance: this.distance };
    const started = performance.now();
    // By Infinity it lands at once.
    this.flight = (now) => {
      const t = Math.min(1, (now - started) / 350);
      const s = t * t * (3 - 2 * t);
      this.target.lerpVectors(from.target, to.target, s);
      this.turned.slerpQuaternions(from.turned, to.turned, s);
      this.distance = from.distance * Math.pow(to.distance / from.distance, s);
      this.apply();
      if (t === 1) this.flight = null;
    };
    this.changed();
  }

  apply() {
    this.camera.quaternion.copy(this.turned);
    this.camera.position.copy(Z).applyQuaternion(this.turned).multiplyScalar(this.distance).add(this.target);
    this.camera.near = this.distance / 50;
    this.camera.far = this.distance * 20 + 500;
    this.changed();
  }

  /** Listen to pointer, wheel and keys on an element; `paneHeight()` returns the height of a pane in pixels. */
  listen(element, paneHeight) {
    element.addEventListener("pointerdown", (event) => {
      if (event.target.closest("button, input, label, a")) return;
      element.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, event);
      this.flight = null;
    });
    element.addEventListener("pointermove", (event) => this.drag(event, paneHeight()));
    for (const name of ["pointerup", "pointercancel"])
      element.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.flight?.(Infinity);
        this.zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.04 : 0.0012)));
      },
      { passive: false },
    );
    element.addEventListener("keydown", (event) => this.key(event, paneHeight()));
  }

  drag(event, height) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    const dx = event.clientX - last.clientX;
    const dy = event.clientY - last.clientY;
    if (this.pointers.size === 2) this.pinch(event, last, dx, dy, height);
    else if (event.buttons & 2 || event.buttons & 4 || event.shiftKey) this.move(dx, dy, height);
    else this.turn((dx / height) * 4, (dy / height) * 4);
    this.pointers.set(event.pointerId, event);
  }

  pinch(event, last, dx, dy, height) {
    const other = [...this.pointers.values()].find((pointer) => pointer.pointerId !== event.pointerId);
    const gap = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY);
    this.zoom(gap(last) / Math.max(gap(event), 1));
    this.move(dx / 2, dy / 2, height);
  }

  key(event, height) {
    if (event.target.closest("button, input, select")) return;
    const step = 0.12;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const arrow = arrows[event.key];
    this.flight?.(Infinity);
    if (arrow && event.shiftKey) this.move(arrow[0] * 30, arrow[1] * 30, height);
    else if (arrow) this.turn(arrow[0] * step, arrow[1] * step);
    else if (event.key === "+" || event.key === "=") this.zoom(1 / 1.15);
    else if (event.key === "-") this.zoom(1.15);
    else if (event.key === "," || event.key === ".") this.roll(event.key === "," ? step : -step);
    else return;
    event.preventDefault();
  }
}
