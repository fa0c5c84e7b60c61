// Images that people choose or drop on the page: whether they are any, and their pixels.

const MOST_PIXELS = 50e6;
const HEAD = 1 << 16; // bytes in which an image says that it moves

export const KINDS = "image/png,image/jpeg,image/webp";

// What kind of image bytes are, and whether it moves; null for none that the page reads.
async function kindOf(file) {
  const head = new Uint8Array(await file.slice(0, HEAD).arrayBuffer()), text = String.fromCharCode(...head.subarray(0, 30));
  const has = (name) => new TextDecoder("latin1").decode(head).includes(name);
  if (text.startsWith("\x89PNG\r\n")) return { kind: "png", moves: has("acTL") };
  if (text.startsWith("\xff\xd8\xff")) return { kind: "jpeg", moves: false };
  if (text.startsWith("RIFF") && text.slice(8, 12) === "WEBP") return { kind: "webp", moves: text.slice(12, 16) === "VP8X" && (head[20] & 2) !== 0 };
  return null;
}

// The size of an image, of which no more is decoded.
async function sizeOf(file) {
  const image = new Image();
  image.src = URL.createObjectURL(file);
  try {
    await new Promise((resolve, reject) => Object.assign(image, { onload: resolve, onerror: reject }));
    return [image.naturalWidth, image.naturalHeight];
  } finally {
    URL.revokeObjectURL(image.src);
  }
}

// Decode a file; `options` as for createImageBitmap. Throws an Error that says in a line what is wrong.
export async function readImage(file, options = {}) {
  let found, size;
  try {
    found = await kindOf(file);
    size = found && (await sizeOf(file));
  } catch {
    throw new Error(found ? `${file.name} is damaged: save it again.` : `${file.name} cannot be read.`);
  }
  if (!found) throw new Error(`${file.name} is no PNG, JPEG or WebP image.`);
  if (found.moves) throw new Error(`${file.name} is animated: save one picture of it.`);
  const [width, height] = size;
  if (width * height > MOST_PIXELS) throw new Error(`${file.name} has ${width} × ${height} pixels: make it smaller than ${MOST_PIXELS / 1e6} million.`);
  try {
    return { kind: found.kind, bitmap: await createImageBitmap(file, options) };
  } catch {
    throw new Error(`${file.name} is damaged: save it again.`);
  }
}

// Call `take` with each file that is dropped on the page, and `say` with what is wrong with what is dropped.
export function onDrop(take, say) {
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    const { items, files } = event.dataTransfer;
    const folder = [...items].map((item) => item.webkitGetAsEntry?.()).find((entry) => entry?.isDirectory);
    if (folder) say(`${folder.name} is a folder: drop one picture.`);
    else if (files.length === 1) take(files[0]);
    else say(files.length ? "Drop one picture at a time." : "Drop a picture that is a file.");
  });
}
