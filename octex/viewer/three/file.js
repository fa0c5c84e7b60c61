// A web file: a header, and streams one after another, coarse levels first. See FORMAT.md.

import { inflated } from "../page/octree.js";

const MAGIC = "octexweb", VERSION = 1, HEAD = 16, START = 100_000;

export class WebFile {
  // `read` takes the bytes from one place up to another, or up to the end.
  constructor(name, read) {
    Object.assign(this, { name, read });
  }

  static of({ name, url, options, buffer }) {
    return buffer ? new WebFile(name, (begin, end) => buffer.slice(begin, end)) : WebFile.fetched(name, url, options);
  }

  // The first bytes, which show a picture, are one request; each later stream is another.
  static fetched(name, url, options) {
    let start = null, whole = null; // of a server that knows no ranges
    const ask = async (begin, end) => {
      const response = await fetch(url, { ...options, headers: { ...options.headers, Range: `bytes=${begin}-${end - 1}` } });
      if (!response.ok) throw new Error(`${name}: ${response.status} ${response.statusText}`);
      if (response.status !== 206) whole = response.arrayBuffer();
      return whole ? (await whole).slice(begin, end) : response.arrayBuffer();
    };
    return new WebFile(name, async (begin, end) => {
      start ??= ask(0, START);
      const first = await start;
      if (end <= first.byteLength) return first.slice(begin, end);
      return whole ? (await whole).slice(begin, end) : ask(begin, end);
    });
  }

  async bytes(begin, end) {
    const bytes = await this.read(begin, end);
    if (bytes.byteLength < end - begin) throw new Error(`${this.name} ends too early: ${end} bytes are expected`);
    return bytes;
  }

  async header() {
    const head = new DataView(await this.bytes(0, HEAD)), magic = new TextDecoder().decode(head.buffer.slice(0, MAGIC.length));
    if (magic !== MAGIC) throw new Error(`${this.name} is no octex web file; octex view TEXTURE MODEL NAME.octw writes one`);
    const version = head.getUint32(8, true), length = head.getUint32(12, true);
    if (version !== VERSION) throw new Error(`${this.name} has version ${version}; this octex-three reads version ${VERSION}`);
    const text = new TextDecoder().decode(await this.bytes(HEAD, HEAD + length));
    const header = this.checked("header", () => JSON.parse(text));
    this.first = HEAD + length;
    this.streams = header.streams;
    return header;
  }

  // The bytes of a stream, unpacked.
  async stream(name) {
    const [begin, length] = this.streams[name], packed = await this.bytes(this.first + begin, this.first + begin + length);
    try {
      return await inflated(new Blob([packed]).stream());
    } catch (error) {
      throw this.damaged(name, error);
    }
  }

  // What `take` makes of a part of the file, which may be damaged.
  checked(name, take) {
    try {
      return take();
    } catch (error) {
      throw this.damaged(name, error);
    }
  }

  damaged(name, cause) {
    return new Error(`${this.name} is damaged, in ${name}; write it again`, { cause });
  }
}
