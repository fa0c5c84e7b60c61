// What a web file holds, in the order in which it is shown: headers, meshes, then levels, coarse ones first.

import { unpackedMesh } from "../page/mesh.js";
import { Octree } from "../page/octree.js";
import { WebFile } from "./file.js";

// Yields { header }, then { part, mesh, bytes } and { part, rows, bytes }. `given` has the file's name, and its url and fetch's
// options, or its buffer.
export async function* contents(given) {
  const file = WebFile.of(given), header = await file.header(), { parts } = header;
  const octrees = file.checked("header", () => parts.map((part) => new Octree(part)));
  yield { header };
  for (const [part, { mesh, source }] of parts.entries()) {
    if (!mesh) continue;
    const name = `${part}-mesh`, bytes = await file.stream(name);
    yield { part, mesh: file.checked(name, () => unpackedMesh(mesh, bytes, source)), bytes: mesh.bytes };
  }
  const most = Math.max(...parts.map(({ chunks }) => chunks.length));
  for (let n = 0; n < most; n++) {
    for (const [part, octree] of octrees.entries()) {
      const chunk = parts[part].chunks[n];
      if (!chunk) continue;
      const name = `${part}-levels-${n}`, bytes = await file.stream(name);
      const taken = file.checked(name, () => (chunk.levels ? octree.take(chunk, bytes) : octree.takeTables(bytes)));
      yield { part, rows: octree.rows(taken), bytes: chunk.bytes };
    }
  }
}

// The same, read in a worker; in this thread where there can be none, as on pages of other origins.
export async function* contentsInWorker(given) {
  const worker = started();
  if (!worker) return yield* contents(given);
  const arrived = [];
  let wake;
  const take = (message) => (arrived.push(message), wake?.());
  worker.onmessage = ({ data }) => take(data);
  worker.onerror = () => take({ isBroken: true });
  worker.postMessage(given);
  try {
    for (let isFirst = true; ; isFirst = false) {
      while (!arrived.length) await new Promise((resolve) => (wake = resolve));
      const message = arrived.shift();
      if (message.isBroken && isFirst) return yield* contents(given);
      if (message.isBroken) throw new Error(`${given.name}: the worker that reads it has ended`);
      if (message.error) throw new Error(message.error);
      if (message.isEnd) return;
      yield message;
    }
  } finally {
    worker.terminate();
  }
}

function started() {
  try {
    return new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
  } catch {
    return null;
  }
}
