// The parent axis: where an abscissa lies, and which one is under a pointer.

const REACH_MM = 9;
const NEAR_PX = 60;

export class Axis {
  /** @param axis {points, abscissa, diameter} @param picture where it is seen */
  constructor({ points, abscissa }, picture) {
    this.points = points;
    this.abscissa = abscissa;
    this.picture = picture;
  }

  /** Where its far end lies. */
  get length() {
    return this.abscissa.at(-1);
  }

  /** Point at an abscissa. */
  at(mm) {
    let i = this.abscissa.findIndex((s) => s >= mm);
    if (i < 0) i = this.abscissa.length - 1;
    return this.points.slice(3 * i, 3 * i + 3);
  }

  /** Abscissa whose picture is nearest to a pointer; nothing far along the artery from `near`, which may lie behind. */
  under(event, near) {
    const [x, y] = this.picture.where(event);
    let [best, least] = [near, Infinity];
    for (let i = 0; i < this.abscissa.length; i++) {
      if (near !== null && Math.abs(this.abscissa[i] - near) > REACH_MM) continue;
      const [u, v] = this.picture.onScreen(this.points.slice(3 * i, 3 * i + 3));
      const distance = Math.hypot(u - x, v - y);
      if (distance < least) [best, least] = [this.abscissa[i], distance];
    }
    return near === null && least > NEAR_PX ? null : best;
  }
}
