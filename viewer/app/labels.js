// Words on the scene, so that colour alone carries nothing.
import { Vector3 } from "three";
import { make } from "../src/dom.js";

/** The word "Sac" beside the sac while it is drawn. */
export class SacLabel {
  constructor(picture) {
    this.picture = picture;
    this.mark = { element: make("span", { className: "opening scene-label" }, [make("b", {}, ["Sac"])]), isLabel: true, point: () => this.point() };
  }

  point() {
    const layer = this.picture.shown.has("sac") && this.picture.stage?.layers.find(({ id }) => id === "sac");
    if (!layer) return null;
    if (!layer.geometry.boundingBox) layer.geometry.computeBoundingBox();
    return layer.geometry.boundingBox.getCenter(new Vector3()).toArray();
  }
}
