// Builds the one bundle that the report and the page embed, and puts the licences of what is in it beside it.
import { build } from "esbuild";
import { createHash } from "node:crypto";
import { copyFile, readdir, readFile, writeFile } from "node:fs/promises";

const assets = new URL("../src/vstent/report/assets/", import.meta.url);

// The sources' hash goes into the bundle: a test tells when one was changed and the other was not.
const hash = createHash("sha256");
for (const name of (await readdir("src")).sort()) hash.update(await readFile(`src/${name}`));
hash.update(await readFile("package-lock.json"));

await build({
  entryPoints: ["src/viewer.js"],
  outfile: new URL("viewer.js", assets).pathname,
  bundle: true,
  minify: true,
  format: "iife",
  globalName: "VstentViewer",
  target: ["chrome100", "firefox100", "safari15"],
  legalComments: "none",
  banner: { js: `/* vstent viewer with three.js and fflate (MIT, see LICENSES.txt); sources ${hash.digest("hex")} */` },
  charset: "utf8",
});
await copyFile("src/viewer.css", new URL("viewer.css", assets));

const licences = [];
for (const name of ["three", "fflate"]) {
  const { version } = JSON.parse(await readFile(`node_modules/${name}/package.json`));
  licences.push(`${name} ${version}\n\n${await readFile(`node_modules/${name}/LICENSE`, "utf8")}`);
}
await writeFile(new URL("LICENSES.txt", assets), licences.join(`\n${"-".repeat(72)}\n\n`));
