// Loads web files: textures, and their meshes if they have any.

import { Group, Loader } from "three";
import { contentsInWorker } from "./contents.js";
import { Shaders, OctreeTexture } from "./texture.js";

export class OctreeTextureLoader extends Loader {
  load(url, onLoad, onProgress, onError) {
    this.loadAsync(url, onProgress).then(onLoad, onError ?? console.error);
  }

  // Returns `textures`, `group` (their meshes, or null), and `complete`, a promise that resolves when the finest levels are
  // loaded. Coarse levels show at once.
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

  // Load a web file from memory.
  parseBuffer(buffer, name = "the web file") {
    return this.parse({ name, buffer });
  }

  // Load a source, see contents.js. An error ends the worker.
  async parse(source, onProgress = () => {}) {
    const reader = contentsInWorker(source);
    const orClose = (promise) => promise.catch(async (error) => {
      await reader.return();
      throw error;
    });
    const [{ value: { header } }, shaders] = await orClose(Promise.all([reader.next(), Shaders.read()]));
    const { parts } = header, textures = parts.map((part) => new OctreeTexture(part, shaders));
    const total = parts.flatMap((part) => [...part.chunks, part.mesh]).reduce((sum, each) => sum + (each?.bytes ?? 0), 0);
    let loaded = 0, levelCount = 0;
    // Load until there are so many chunks of levels, or all.
    const load = async (count) => {
      while (levelCount < count) {
        const { value, done } = await reader.next();
        if (done) return;
        const { part, mesh, rows, bytes } = value;
        if (mesh) textures[part].setMesh(mesh);
        else textures[part].setRows(rows);
        levelCount += rows ? 1 : 0;
        onProgress({ loaded: (loaded += bytes), total, lengthComputable: true });
      }
    };
    await orClose(load(parts.length));
    const meshes = textures.map((texture) => texture.mesh).filter(Boolean);
    const group = meshes.length ? new Group().add(...meshes) : null;
    return { textures, group, complete: orClose(load(Infinity)) };
  }
}
