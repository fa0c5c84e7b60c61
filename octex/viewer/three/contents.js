// Reads a web file in the order in which it is shown: header, meshes, then levels, coarse ones first.

import { unpackedMesh } from "../page/mesh.js";
import { Octree } from "../page/octree.js";
import { WebFile } from "./file.js";

// Yields { header }, then { part, mesh, bytes } and { part, rows, bytes }. `source` has the file's name, and either its url
// with options of fetch, or a buffer.
export async function* contents(source) {
  const file = WebFile.of(source), header = await file.header(), { parts } = header;
  const octrees = file.checked("header", () => parts.map((part) => new Octree(part)));
  yield { header };
  for (const [part, { mesh, source: images }] of parts.entries()) {
    if (!mesh) continue;
    const name = `${part}-mesh`, bytes = await file.stream(name);
    yield { part, mesh: file.checked(name, () => unpackedMesh(mesh, bytes, images)), bytes: mesh.bytes };
  }
  const chunkCount = Math.max(...parts.map(({ chunks }) => chunks.length));
  for (let n = 0; n < chunkCount; n++) {
    for (const [part, octree] of octrees.entries()) {
      const chunk = parts[part].chunks[n];
      if (!chunk) continue;
      const name = `${part}-levels-${n}`, bytes = await file.stream(name);
      const ranges = file.checked(name, () => octree.readChunk(chunk, bytes));
      yield { part, rows: octree.copyRows(ranges), bytes: chunk.bytes };
    }
  }
}

// The same in a worker; in this thread where a worker cannot start, as on pages of other origins.
export async function* contentsInWorker(source) {
  const worker = startedWorker();
  if (!worker) return yield* contents(source);
  const messages = [];
  let wake;
  const receive = (message) => (messages.push(message), wake?.());
  worker.onmessage = ({ data }) => receive(data);
  worker.onerror = () => receive({ isBroken: true });
  worker.postMessage(source);
  try {
    for (let isFirst = true; ; isFirst = false) {
      while (!messages.length) await new Promise((resolve) => (wake = resolve));
      const message = messages.shift();
      if (message.isBroken && isFirst) return yield* contents(source);
      if (message.isBroken) throw new Error(`${source.name}: the worker that reads it has ended`);
      if (message.error) throw new Error(message.error);
      if (message.isEnd) return;
      yield message;
    }
  } finally {
    worker.terminate();
  }
}

function startedWorker() {
  try {
    return new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
  } catch {
    return null;
  }
}
