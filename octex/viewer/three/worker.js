// Reads a web file in a worker. See contents.js.

import { contents } from "./contents.js";

const buffersOf = ({ mesh, rows }) => Object.values(mesh ?? rows ?? {}).flat().map((array) => array?.buffer).filter(Boolean);

onmessage = async ({ data: source }) => {
  try {
    for await (const content of contents(source)) postMessage(content, [...new Set(buffersOf(content))]);
    postMessage({ isEnd: true });
  } catch ({ message }) {
    postMessage({ error: message });
  }
};
