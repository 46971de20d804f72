// Builds the two bundles, the report's viewer and the page, and puts the licences of what is in them beside them.
import { build } from "esbuild";
import { createHash } from "node:crypto";
import { copyFile, readdir, readFile, writeFile } from "node:fs/promises";

const assets = new URL("../src/vstent/reporting/assets/", import.meta.url);
const page = new URL("../src/vstent/app/assets/", import.meta.url);

/** The sources' hash goes into a bundle: a test tells when one was changed and the other was not. */
async function digest(...folders) {
  const hash = createHash("sha256");
  for (const folder of folders) for (const name of (await readdir(folder)).sort()) hash.update(await readFile(`${folder}/${name}`));
  hash.update(await readFile("package-lock.json"));
  return hash.digest("hex");
}

async function bundle(entry, outfile, sources, more) {
  await build({
    entryPoints: [entry],
    outfile: outfile.pathname,
    bundle: true,
    minify: true,
    format: "iife",
    target: ["chrome100", "firefox100", "safari15"],
    legalComments: "none",
    banner: { js: `/* vstent; three.js and fflate (MIT, see LICENSES.txt) in viewer.js; sources ${sources} */` },
    charset: "utf8",
    ...more,
  });
}

/** The page takes from the viewer's bundle what it shares with it. */
const shared = {
  name: "shared",
  setup(builder) {
    builder.onResolve({ filter: /^(three|\.\.\/src\/.*)$/ }, ({ path }) => ({ path, namespace: "shared" }));
    builder.onLoad({ filter: /.*/, namespace: "shared" }, () => ({ contents: "module.exports = VstentViewer;" }));
  },
};

await bundle("src/viewer.js", new URL("viewer.js", assets), await digest("src"), { globalName: "VstentViewer" });
await bundle("app/main.js", new URL("app.js", page), await digest("src", "app"), { plugins: [shared] });
await copyFile("app/app.css", new URL("app.css", page));
await copyFile("src/viewer.css", new URL("viewer.css", assets));

const licences = [];
for (const name of ["three", "fflate"]) {
  const { version } = JSON.parse(await readFile(`node_modules/${name}/package.json`));
  licences.push(`${name} ${version}\n\n${await readFile(`node_modules/${name}/LICENSE`, "utf8")}`);
}
await writeFile(new URL("LICENSES.txt", assets), licences.join(`\n${"-".repeat(72)}\n\n`));
