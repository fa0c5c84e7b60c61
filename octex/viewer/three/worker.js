// Reads a web file beside the page's thread. See contents.js.

import { contents } from "./contents.js";

const buffersOf = ({ mesh, rows }) => Object.values(mesh ?? rows ?? {}).flat().map((array) => array?.buffer).filter(Boolean);

onmessage = async ({ data }) => {
  try {
    for await (const each of contents(data)) postMessage(each, [...new Set(buffersOf(each))]);
    postMessage({ isEnd: true });
  } catch ({ message }) {
    postMessage({ error: message });
  }
};
