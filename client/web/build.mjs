// Pages to dist/, which `mapless-server gateway --pages` serves; the emulated headset of the tests to build/.
import { cpSync, rmSync } from "node:fs";
import { build } from "esbuild";

const options = { bundle: true, minify: true, sourcemap: true, target: "es2022", logLevel: "warning" };
rmSync("dist", { recursive: true, force: true });
cpSync("public", "dist", { recursive: true });
await build({ ...options, entryPoints: ["src/webxr.ts", "src/photo.ts"], outdir: "dist", format: "esm" });
await build({ ...options, sourcemap: false, entryPoints: ["test/emulated.ts"], outdir: "build", format: "iife" });
