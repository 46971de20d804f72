// Words on the scene, so that colour alone carries nothing.
import { make } from "../src/dom.js";

/** Names of the sacs beside them while they are drawn; of several sacs a click on a name chooses that one. */
export function sacMarks({ sacs }, picture, choose) {
  return sacs.map(({ center_mm, volume_mm3 }, i) => {
    const one = () => make("span", { className: "opening scene-label" }, [make("b", {}, ["Sac"])]);
    const words = [make("b", {}, [`Sac ${i + 1}`]), make("span", {}, [`${volume_mm3.toFixed(0)} mm³`])];
    const title = i ? "Click to choose this sac" : "Devices and flow refer to this sac";
    const several = () => make("button", { type: "button", className: "opening sac", title, disabled: !i, onClick: () => choose(center_mm) }, words);
    return { element: sacs.length > 1 ? several() : one(), isLabel: true, point: () => picture.shown.has("sac") && center_mm };
  });
}
