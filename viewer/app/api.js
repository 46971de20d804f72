// Words with the server: JSON, binary messages, events; and a line in which the newest request wins.
import { opened } from "../src/decode.js";
import { askForKey } from "./dialogs.js";

/** What the server refused, in its own sentence. */
export class Refusal extends Error {
  constructor(status, sentence) {
    super(sentence);
    this.status = status;
  }
}

const FIELDS = { cell_size_mm: "Grid spacing", inflow_mL_s: "Mean inflow", upstream_mm: "Before sac", downstream_mm: "Beyond sac", spacing_mm: "Voxel spacing", shape: "Voxels" };

/** What is wrong with a field, and its name. */
function said({ loc, msg }) {
  const name = loc.filter((part) => typeof part === "string").at(-1);
  return `${FIELDS[name] ?? name.replaceAll("_", " ")}: ${msg.replace(/^Value error, /, "")}`;
}

async function ask(method, path, body) {
  const options = { method, headers: {} };
  if (body instanceof Blob) options.body = body;
  else if (body !== undefined) {
    options.body = JSON.stringify(body);
    options.headers["content-type"] = "application/json";
  }
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Refusal(0, `The server does not answer. Start it again with: vstent app --port ${location.port}`);
  }
  if (answer.ok) return answer;
  if (answer.status === 401) askForKey();
  const text = await answer.text();
  let sentence = text;
  try {
    const { detail } = JSON.parse(text);
    sentence = typeof detail === "string" ? detail : detail.map(said).join("; ");
  } catch {
    // not JSON: the text is the sentence
  }
  throw new Refusal(answer.status, sentence);
}

export const get = async (path) => (await ask("GET", path)).json();
export const post = async (path, body) => (await ask("POST", path, body)).json();
export const put = async (path, body) => (await ask("PUT", path, body)).json();
export const putBytes = (path, blob) => ask("PUT", path, blob);
export const drop = async (path) => (await ask("DELETE", path)).json();
export const getBinary = async (path) => opened(await (await ask("GET", path)).arrayBuffer());
export const postBinary = async (path, body) => opened(await (await ask("POST", path, body)).arrayBuffer());

/** One request at a time; of those that wait only the newest is made. */
export class Newest {
  constructor(taken, failed) {
    this.taken = taken;
    this.failed = failed;
    this.waiting = null;
    this.isBusy = false;
  }

  async ask(make) {
    this.waiting = make;
    if (this.isBusy) return;
    this.isBusy = true;
    while (this.waiting) {
      const next = this.waiting;
      this.waiting = null;
      try {
        this.taken(await next());
      } catch (problem) {
        this.failed(problem);
      }
    }
    this.isBusy = false;
  }
}
