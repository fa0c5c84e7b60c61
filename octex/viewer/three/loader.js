// Reads web files: textures, and their meshes if they have any.

import { Group, Loader } from "three";
import { WebFile } from "./file.js";
import { Shaders, OctreeTexture } from "./texture.js";

export class OctreeTextureLoader extends Loader {
  load(url, onLoad, onProgress, onError) {
    this.loadAsync(url, onProgress).then(onLoad, onError ?? console.error);
  }

  // Returns an object with `textures`, `group` (their meshes; null without), and `complete`, which resolves when the finest
  // levels are there. What is returned shows the first levels at once.
  async loadAsync(url, onProgress) {
    const path = this.manager.resolveURL(this.path + url), options = { headers: this.requestHeader, credentials: this.withCredentials ? "include" : "same-origin" };
    this.manager.itemStart(url);
    try {
      const loaded = await this.parse(WebFile.fetched(path, options), onProgress);
      const end = () => this.manager.itemEnd(url);
      loaded.complete.then(end, () => (this.manager.itemError(url), end()));
      return loaded;
    } catch (error) {
      this.manager.itemError(url);
      this.manager.itemEnd(url);
      throw error;
    }
  }

  // Take a web file that is in memory.
  parseBuffer(buffer, name = "the web file") {
    return this.parse(new WebFile(name, (begin, end) => buffer.slice(begin, end)));
  }

  async parse(file, onProgress = () => {}) {
    const [header, shaders] = await Promise.all([file.header(), Shaders.read()]), { parts } = header;
    const textures = parts.map((part) => new OctreeTexture(part, shaders));
    const total = parts.flatMap((part) => [...part.chunks, part.mesh]).reduce((sum, each) => sum + (each?.bytes ?? 0), 0);
    let loaded = 0;
    const progress = (bytes) => onProgress({ loaded: (loaded += bytes), total, lengthComputable: true });
    for (const [number, texture] of textures.entries()) {
      if (!parts[number].mesh) continue;
      const bytes = await file.stream(`${number}-mesh`);
      file.checked(`${number}-mesh`, () => texture.takeMesh(bytes));
      progress(parts[number].mesh.bytes);
    }
    const takeChunk = async (n) => {
      for (const [number, texture] of textures.entries()) {
        const chunk = parts[number].chunks[n];
        if (!chunk) continue;
        const name = `${number}-levels-${n}`, bytes = await file.stream(name);
        file.checked(name, () => texture.take(chunk, bytes));
        progress(chunk.bytes);
      }
    };
    const most = Math.max(...parts.map(({ chunks }) => chunks.length));
    await takeChunk(0);
    const rest = async () => {
      for (let n = 1; n < most; n++) await takeChunk(n);
    };
    const meshes = textures.map((texture) => texture.mesh).filter(Boolean);
    const group = meshes.length ? new Group().add(...meshes) : null;
    return { textures, group, complete: rest() };
  }
}
