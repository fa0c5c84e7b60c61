// Loads the page's data: from the server, or from elements of the page.

import { inflate } from "./octree.js";

const embedded = (name) => document.getElementById(`data-${name}`);

export const isServed = !embedded("header"); // false for a page that is one file

const GONE = 410; // HTTP status of a version that the server no longer has
let folder = "data"; // path of the streams of the version that is loaded

// The page must load everything again: the server no longer has its version, or a change could not be applied.
export class ReloadError extends Error {}

async function fetchFresh(path) {
  const response = await fetch(path, { cache: "no-store" });
  if (response.ok) return response;
  throw new (response.status === GONE ? ReloadError : Error)(await response.text());
}

export async function readHeader() {
  const element = embedded("header");
  if (element) return JSON.parse(element.textContent);
  const header = await (await fetchFresh("data/header")).json();
  folder = `data/${header.version}`;
  return header;
}

// Read the header of the change from a version to the next one. The streams that are read next belong to it.
export async function readChange(version) {
  folder = `data/${version}`;
  return (await fetchFresh(`${folder}/change`)).json();
}

export async function readStream(name) {
  return inflate(await readFile(name));
}

// Read a file as a Blob: an image, or a deflated stream.
export async function readFile(name) {
  const part = embedded(name);
  if (part) {
    const text = atob(part.textContent.trim());
    part.textContent = "";
    return new Blob([Uint8Array.from(text, (letter) => letter.charCodeAt(0))]);
  }
  return (await fetchFresh(`${folder}/${name}`)).blob();
}

export async function readShaders(names) {
  if (embedded("shaders")) return JSON.parse(new TextDecoder().decode(await readStream("shaders")));
  const texts = names.map(async (name) => [name, await (await fetchFresh(`shaders/${name}`)).text()]);
  return Object.fromEntries(await Promise.all(texts));
}

// Ask the server with an object; returns the answer's line of JSON and the bytes after it.
export async function query(path, question) {
  const response = await fetch(`${path}?${encodeURIComponent(JSON.stringify(question))}`).catch(() => {
    throw new Error("the connection is lost");
  });
  if (!response.ok) throw new Error((await response.text()).trim());
  const bytes = new Uint8Array(await response.arrayBuffer()), end = bytes.indexOf(10);
  return { header: JSON.parse(new TextDecoder().decode(bytes.subarray(0, end))), bytes: bytes.subarray(end + 1) };
}
