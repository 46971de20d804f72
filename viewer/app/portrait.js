// The picture of a case in the list of cases: what its 3-D view shows, small.
import { putBytes } from "./api.js";

const [WIDTH, HEIGHT] = [320, 200];
const REST_MS = 1500;

export class Portrait {
  constructor(page) {
    this.page = page;
  }

  /** Take a picture of what is new, once the view lies still. */
  take(key) {
    clearTimeout(this.timer);
    if (key !== this.taken) this.timer = setTimeout(() => this.keep(key), REST_MS);
  }

  keep(key) {
    const { picture, path, view } = this.page;
    if (!picture.stage || !view || this.page.frame.hidden || picture.area.clientWidth < 50) return;
    picture.stage.draw(); // a canvas can be read only right after it was drawn
    const { canvas } = picture;
    const small = document.createElement("canvas");
    [small.width, small.height] = [WIDTH, HEIGHT];
    const scale = Math.max(WIDTH / canvas.width, HEIGHT / canvas.height);
    const [w, h] = [canvas.width * scale, canvas.height * scale];
    const context = small.getContext("2d");
    context.drawImage(canvas, (WIDTH - w) / 2, (HEIGHT - h) / 2, w, h);
    this.taken = key;
    small.toBlob((blob) => blob && putBytes(`${path}/picture`, blob).catch(() => {}), "image/png");
  }
}
