// Where the page's data comes from: a server, or the page itself.

import { reload } from "./kept.js";
import { inflated } from "./octree.js";

function embedded(name) {
  return document.getElementById(`data-${name}`);
}

export const isServed = !embedded("header"); // else the page is a file

const GONE = 410;
let place = "data"; // where the streams of the version are that is shown

async function answered(name) {
  const response = await fetch(name, { cache: "no-store" });
  if (response.status === GONE) {
    reload(); // the texture has changed while it came
    return new Promise(() => {});
  }
  if (!response.ok) throw new Error(await response.text());
  return response;
}

export async function readHeader() {
  const element = embedded("header");
  if (element) return JSON.parse(element.textContent);
  const header = await (await answered("data/header")).json();
  place = `data/${header.version}`;
  return header;
}

// The change from a version to the next one, a header; or null if it is not there.
export async function readChange(version) {
  place = `data/${version}`;
  const response = await fetch(`${place}/change`, { cache: "no-store" });
  return response.ok ? response.json() : null;
}

export async function readStream(name) {
  return inflated((await readFile(name)).stream());
}

// A file as it is: what a stream holds deflated, or an image.
export async function readFile(name) {
  const part = embedded(name);
  if (part) {
    const text = atob(part.textContent.trim());
    const bytes = new Uint8Array(text.length);
    for (let n = 0; n < text.length; n++) bytes[n] = text.charCodeAt(n);
    part.textContent = "";
    return new Blob([bytes]);
  }
  return (await answered(`${place}/${name}`)).blob();
}

export async function readShaders(names) {
  if (embedded("shaders")) return JSON.parse(new TextDecoder().decode(await readStream("shaders")));
  const texts = names.map(async (name) => [name, await (await answered(`shaders/${name}`)).text()]);
  return Object.fromEntries(await Promise.all(texts));
}
