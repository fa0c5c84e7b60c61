// Where the page's data comes from: a server, or the page itself.

async function inflated(stream) {
  const unpacked = stream.pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(unpacked).arrayBuffer());
}

function embedded(name) {
  return document.getElementById(`data-${name}`);
}

export async function readHeader() {
  const element = embedded("header");
  if (element) return JSON.parse(element.textContent);
  const response = await fetch("data/header", { cache: "no-store" });
  if (!response.ok) throw new Error(await response.text());
  return response.json();
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
  const response = await fetch(`data/${name}`, { cache: "no-store" });
  if (!response.ok) throw new Error(await response.text());
  return response.blob();
}

export async function readShader(name) {
  const element = document.getElementById(`shader-${name}`);
  if (element) return element.textContent;
  const response = await fetch(`shaders/${name}`);
  if (!response.ok) throw new Error(await response.text());
  return response.text();
}
