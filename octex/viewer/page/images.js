// Reads image files that the user chooses or drops on the page.

const MAX_PIXELS = 50e6;
const HEAD_BYTES = 1 << 16; // bytes in which a file says that it is animated

export const IMAGE_TYPES = "image/png,image/jpeg,image/webp";

// The format of a file, and whether it is animated; null for other files.
async function formatOf(file) {
  const head = new Uint8Array(await file.slice(0, HEAD_BYTES).arrayBuffer()), text = String.fromCharCode(...head.subarray(0, 30));
  const has = (name) => new TextDecoder("latin1").decode(head).includes(name);
  if (text.startsWith("\x89PNG\r\n")) return { kind: "png", isAnimated: has("acTL") };
  if (text.startsWith("\xff\xd8\xff")) return { kind: "jpeg", isAnimated: false };
  if (text.startsWith("RIFF") && text.slice(8, 12) === "WEBP") return { kind: "webp", isAnimated: text.slice(12, 16) === "VP8X" && (head[20] & 2) !== 0 };
  return null;
}

// The size of an image, before its pixels are decoded.
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

// Decode a file with options of createImageBitmap. Throws an Error with a message for the user.
export async function readImage(file, options = {}) {
  let format, size;
  try {
    format = await formatOf(file);
    size = format && (await sizeOf(file));
  } catch {
    throw new Error(format ? `${file.name} is damaged: save it again.` : `${file.name} cannot be read.`);
  }
  if (!format) throw new Error(`${file.name} is no PNG, JPEG or WebP image.`);
  if (format.isAnimated) throw new Error(`${file.name} is animated: save one image of it.`);
  const [width, height] = size;
  if (width * height > MAX_PIXELS) throw new Error(`${file.name} has ${width} × ${height} pixels: make it smaller than ${MAX_PIXELS / 1e6} million.`);
  try {
    return { kind: format.kind, bitmap: await createImageBitmap(file, options) };
  } catch {
    throw new Error(`${file.name} is damaged: save it again.`);
  }
}

// Call `take` with each file that is dropped on the page, and `showMessage` with a reason to refuse others.
export function onDrop(take, showMessage) {
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    const { items, files } = event.dataTransfer;
    const folder = [...items].map((item) => item.webkitGetAsEntry?.()).find((entry) => entry?.isDirectory);
    if (folder) showMessage(`${folder.name} is a folder: drop one image.`);
    else if (files.length === 1) take(files[0]);
    else showMessage(files.length ? "Drop one image at a time." : "Drop an image that is a file.");
  });
}
