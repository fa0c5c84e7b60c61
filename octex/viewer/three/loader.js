// Reads web files: textures, and their meshes if they have any.

import { Group, Loader } from "three";
import { contentsInWorker } from "./contents.js";
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
      const loaded = await this.parse({ name: path, url: new URL(path, location.href).href, options }, onProgress);
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
    return this.parse({ name, buffer });
  }

  // Read a file: its name, and its url and fetch's options, or its buffer.
  async parse(given, onProgress = () => {}) {
    const arriving = contentsInWorker(given), [{ value: { header } }, shaders] = await Promise.all([arriving.next(), Shaders.read()]);
    const { parts } = header, textures = parts.map((part) => new OctreeTexture(part, shaders));
    const total = parts.flatMap((part) => [...part.chunks, part.mesh]).reduce((sum, each) => sum + (each?.bytes ?? 0), 0);
    let loaded = 0, hasLevels = 0;
    const takeNext = async () => {
      const { value, done } = await arriving.next();
      if (done) return false;
      const { part, mesh, rows, bytes } = value;
      if (mesh) textures[part].takeMesh(mesh);
      else textures[part].take(rows);
      hasLevels += rows ? 1 : 0;
      onProgress({ loaded: (loaded += bytes), total, lengthComputable: true });
      return true;
    };
    while (hasLevels < parts.length && (await takeNext()));
    const rest = async () => {
      while (await takeNext());
    };
    const meshes = textures.map((texture) => texture.mesh).filter(Boolean);
    const group = meshes.length ? new Group().add(...meshes) : null;
    return { textures, group, complete: rest() };
  }
}
