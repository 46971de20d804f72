// Treatments: what is chosen, one or several devices one after the other, and what they are called.

/** A treatment of one device, in the form of a study's settings; a missing size is proposed. */
export function withDevice(device, { diameter_mm = null, length_mm = null } = {}) {
  return { name: device, implants: [{ id: device, device, diameter_mm, length_mm }] };
}

/** Whether a treatment is that of a single device, as the list of devices offers it. */
export const isOfDevice = ({ name, implants }) => implants.length === 1 && implants[0].device === name;

/** How implants can be joined: by the sign of the command line, with what stands between them in a name. */
export const JOINS = { "+": ["each inside those before it", "+"], "|": ["side by side (kissing)", "_beside_"], "&": ["as if each were alone", "_over_"] };

/** The sign that joins the implants of a treatment; nothing where each is joined in its own way. */
export function signOf({ implants }) {
  if (implants.every(({ inside }, i) => inside.length === i)) return "+";
  if (implants.some(({ inside }) => inside.length)) return null;
  return implants.every(({ placing }) => placing.beside.length === implants.length - 1) ? "|" : implants.every(({ placing }) => !placing.beside.length) ? "&" : null;
}

/** A treatment of implants in the order of their deployment, joined by a sign, named as on the command line. */
export function joined(implants, sign = "+") {
  const named = [];
  for (const implant of implants) {
    let id = implant.device;
    for (let n = 2; named.some((other) => other.id === id); n++) id = `${implant.device}_${n}`;
    named.push({ ...implant, id, inside: sign === "+" ? named.map((other) => other.id) : [] });
  }
  const paths = named.map(({ placing }) => placing?.path);
  for (const implant of named) implant.placing = { ...implant.placing, beside: sign === "|" ? paths.filter((path) => path !== implant.placing.path) : [] };
  return { name: named.map(({ id }) => id).join(JOINS[sign][1]), implants: named };
}

/** What changes of one implant make of the choices. */
export const implantWith = (name, id, changes) => ({ treatments }) => ({
  treatments: treatments.map((treatment) =>
    treatment.name === name ? { ...treatment, implants: treatment.implants.map((implant) => (implant.id === id ? { ...implant, ...changes } : implant)) } : treatment,
  ),
});

/** The place of an implant whose middle, or lower end of a basket, was put somewhere, or which is left to be proposed (null). */
export const placedAt = ({ placing }, mm, isBasket) => ({
  placing: isBasket ? { ...placing, shift_mm: mm ?? 0 } : { ...placing, position_mm: mm, anchor: "center", shift_mm: 0, at_fork: false },
});

/** Whether an implant was placed by hand. */
export const isPlaced = ({ placing }) => placing.position_mm !== null || placing.shift_mm !== 0;

export class Names {
  /** @param catalogue the designs @param chosen() the chosen treatments */
  constructor(catalogue, chosen) {
    this.catalogue = catalogue;
    this.chosen = chosen;
  }

  device(key) {
    return this.catalogue.find((design) => design.key === key)?.name || key;
  }

  /** Whether a device is for a use, as the catalogue names it: ``basket``, ``coils``. */
  isFor(key, use) {
    return this.catalogue.find((design) => design.key === key)?.use === use;
  }

  /** Whether a device lies in an artery, and not in a sac. */
  isStent(key) {
    return !this.isFor(key, "basket") && !this.isFor(key, "coils");
  }

  /** A treatment by its name: its devices, or the name that it was given. */
  treatment(name) {
    const implants = this.chosen().find((treatment) => treatment.name === name)?.implants;
    const sign = implants && Object.keys(JOINS).find((key) => name === implants.map(({ id }) => id).join(JOINS[key][1]));
    return sign ? implants.map(({ device }) => this.device(device)).join(` ${sign} `) : this.device(name);
  }

  /** An implant of a treatment: its device, with its place in the order where there are several. */
  implant(name, id) {
    const implants = this.chosen().find((treatment) => treatment.name === name)?.implants || [];
    const place = implants.findIndex((implant) => implant.id === id);
    if (place < 0) return id;
    return `${implants.length > 1 ? `${place + 1}. ` : ""}${this.device(implants[place].device)}`;
  }
}
