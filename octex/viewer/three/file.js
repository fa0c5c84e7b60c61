// A web file: a header, then streams, coarse levels first. See FORMAT.md.

import { inflate } from "../page/octree.js";

const MAGIC = "octexweb", VERSION = 1;
const HEAD_BYTES = 16, FIRST_BYTES = 100_000; // of the fixed fields, and of the first request

export class WebFile {
  // `read` returns the bytes from `begin` to `end`, or to the file's end.
  constructor(name, read) {
    Object.assign(this, { name, read });
  }

  // A file from `contents`'s source.
  static of({ name, url, options, buffer }) {
    return buffer ? new WebFile(name, (begin, end) => buffer.slice(begin, end)) : WebFile.fetched(name, url, options);
  }

  // One request reads the first bytes, which hold the coarse levels; each later stream is another request.
  static fetched(name, url, options) {
    let first = null, whole = null; // `whole`: the file, if the server ignores ranges
    const request = async (begin, end) => {
      const response = await fetch(url, { ...options, headers: { ...options.headers, Range: `bytes=${begin}-${end - 1}` } });
      if (response.status === 416) return new ArrayBuffer(0); // the file ends before
      if (!response.ok) throw new Error(`${name}: ${response.status} ${response.statusText}`);
      if (response.status !== 206) whole = response.arrayBuffer();
      return whole ? (await whole).slice(begin, end) : response.arrayBuffer();
    };
    return new WebFile(name, async (begin, end) => {
      first ??= request(0, FIRST_BYTES);
      const bytes = await first;
      if (end <= bytes.byteLength) return bytes.slice(begin, end);
      return whole ? (await whole).slice(begin, end) : request(begin, end);
    });
  }

  async bytes(begin, end) {
    const bytes = await this.read(begin, end);
    if (bytes.byteLength < end - begin) throw new Error(`${this.name} ends too early: ${end} bytes are expected`);
    return bytes;
  }

  async header() {
    const head = new DataView(await this.bytes(0, HEAD_BYTES)), magic = new TextDecoder().decode(head.buffer.slice(0, MAGIC.length));
    if (magic !== MAGIC) throw new Error(`${this.name} is no octex web file; octex view TEXTURE MODEL NAME.octw writes one`);
    const version = head.getUint32(8, true), length = head.getUint32(12, true);
    if (version !== VERSION) throw new Error(`${this.name} has version ${version}; this octex-three reads version ${VERSION}`);
    const text = new TextDecoder().decode(await this.bytes(HEAD_BYTES, HEAD_BYTES + length));
    const header = this.checked("header", () => JSON.parse(text));
    this.streamsBegin = HEAD_BYTES + length;
    this.streams = header.streams;
    return header;
  }

  // Read a stream and unpack it.
  async stream(name) {
    const [begin, length] = this.streams[name], packed = await this.bytes(this.streamsBegin + begin, this.streamsBegin + begin + length);
    try {
      return await inflate(new Blob([packed]));
    } catch (error) {
      throw this.damaged(name, error);
    }
  }

  // Return what `read` returns; errors say which part of the file is damaged.
  checked(name, read) {
    try {
      return read();
    } catch (error) {
      throw this.damaged(name, error);
    }
  }

  damaged(name, cause) {
    return new Error(`${this.name} is damaged, in ${name}; write it again`, { cause });
  }
}
