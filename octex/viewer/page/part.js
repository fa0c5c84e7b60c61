// A texture and its mesh in GPU memory; the page of a set has several parts.

import { GROWTH, Octree, ROW } from "./octree.js";
import { applyChange } from "./change.js";

const CUBE_BYTES = 20;

export class Part {
  constructor(header) {
    this.header = header;
    this.octree = new Octree(header);
    this.mesh = null;
    this.motion = null;
    this.source = null;
  }

  // The deepest level whose rows fit into this GPU's textures.
  get deepest() {
    return this.octree.deepestIn(this.maxRows);
  }

  // The lowest and the highest corner of the mesh, or of the root cell.
  get bounds() {
    const { origin, size } = this.header, { mesh } = this;
    if (!mesh) return [origin, origin.map((x) => x + size)];
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    mesh.positions.forEach((x, n) => {
      low[n % 3] = Math.min(low[n % 3], x);
      high[n % 3] = Math.max(high[n % 3], x);
    });
    return [low, high];
  }

  // Whether loaded cells may be translucent.
  get hasAlpha() {
    return this.octree.depth >= 0 && this.channel("alpha")?.components === 1;
  }

  channel(name) {
    return this.header.channels.find((channel) => channel.name === name);
  }

  // Create all GPU objects, at first and after a lost context.
  build(gl) {
    const { octree } = this;
    this.gl = gl;
    this.createStores();
    const last = octree.tables.kept + octree.tables.split ? octree.planes[0].length / 4 : octree.cells[octree.depth + 1];
    const entries = [0, octree.entries.length / 2];
    if (octree.depth >= 0) this.upload({ nodes: [0, octree.nodes[octree.depth]], cells: [0, last], entries });
    if (this.mesh) this.setMesh(this.mesh);
    if (this.motion && this.mesh.owners) this.setMotion(this.motion);
    this.source?.build(gl);
    this.cubes = null;
  }

  // Create the octree's textures: nodes, entries, and an array texture each for sRGB planes and for other planes. A store is
  // a texture with the arrays (`read`) whose rows it holds.
  createStores() {
    const { gl, octree } = this, { planes } = octree.header, pairs = [gl.RG_INTEGER, gl.UNSIGNED_INT], bytes = [gl.RGBA, gl.UNSIGNED_BYTE];
    const store = (name, size, format, source, read, kind = gl.TEXTURE_2D) => ({ name, size, format, source, read, kind, texture: null, rows: 0 });
    const layered = (name, format, isSrgb) => store(name, 4, format, bytes, () => octree.planes.filter((_, n) => planes[n] === isSrgb), gl.TEXTURE_2D_ARRAY);
    const all = [store("u_nodes", 2, gl.RG32UI, pairs, () => [octree.words]), store("u_entries", 2, gl.RG32UI, pairs, () => [octree.entries])];
    all.push(layered("u_srgb", gl.SRGB8_ALPHA8, true), layered("u_linear", gl.RGBA8, false));
    this.stores = all.filter((each) => each.read().length);
    for (const each of this.stores) this.allocate(each);
  }

  // Create the texture of a store, with spare room as a share of its size.
  allocate(store, room = 0) {
    const arrays = store.read();
    store.rows = Math.min(Math.ceil((arrays[0].length / (store.size * ROW)) * (1 + room)), this.maxRows);
    store.texture = this.texture(store.format, store.rows, store.kind === this.gl.TEXTURE_2D ? 0 : arrays.length);
  }

  get maxRows() {
    return this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE);
  }

  // Create a texture of ROW texels a row; an array texture if it has layers.
  texture(format, rows, layers = 0) {
    const { gl } = this, texture = gl.createTexture(), kind = layers ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D;
    gl.bindTexture(kind, texture);
    if (layers) gl.texStorage3D(kind, 1, format, ROW, rows, layers);
    else gl.texStorage2D(kind, 1, format, ROW, rows);
    gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  // Upload texture rows `begin` … `end - 1` of a store; returns how many, of all layers.
  uploadRows({ read, size, source, kind, texture, rows }, begin, end) {
    const { gl } = this, count = Math.min(end, rows) - begin, arrays = read();
    if (count <= 0) return 0;
    gl.bindTexture(kind, texture);
    arrays.forEach((array, layer) => {
      const texels = array.subarray(size * ROW * begin, size * ROW * (begin + count));
      if (kind === gl.TEXTURE_2D) gl.texSubImage2D(kind, 0, 0, begin, ROW, count, ...source, texels);
      else gl.texSubImage3D(kind, 0, 0, begin, layer, ROW, count, 1, ...source, texels);
    });
    return count * arrays.length;
  }

  // Upload the texture rows of ranges of nodes, cells and entries.
  upload({ nodes, cells, entries }) {
    for (const store of this.stores) {
      const [first, end] = { u_nodes: nodes, u_entries: entries }[store.name] ?? cells;
      this.uploadRows(store, Math.floor(first / ROW), Math.ceil(end / ROW));
    }
  }

  // Apply a change of the octree, and upload the texture rows that differ; textures that are too small are created again with
  // spare room. `added` has the values of new channels, if there are any. Returns the number of rows uploaded.
  change(header, counts, bytes, added) {
    const { octree } = this;
    if (added) {
      octree.relayout(header, added);
      Object.assign(this.header, { channels: header.channels, area: header.area, flags: header.flags, planes: header.planes });
      this.freeStores();
      this.createStores();
    }
    const { nodes, entries, cells } = applyChange(octree, header, counts, bytes);
    octree.header = Object.assign(this.header, header);
    let uploaded = 0;
    for (const store of this.stores) {
      const marks = { u_nodes: nodes, u_entries: entries }[store.name] ?? cells;
      const rows = Math.min(marks.length, this.maxRows), isSmall = rows > store.rows, fits = !isSmall && !added;
      if (isSmall) {
        this.gl.deleteTexture(store.texture);
        this.allocate(store, GROWTH);
      }
      for (let begin = 0, end; begin < rows; begin = end + 1) {
        for (end = begin; end < rows && (!fits || marks[end]); ) end++;
        uploaded += this.uploadRows(store, begin, end);
      }
    }
    this.freeCubes();
    return uploaded;
  }

  // Free the arrays that the GPU has a copy of: the octree can then be looked up, but not changed.
  freeArrays() {
    const { octree } = this;
    octree.words = octree.planes = octree.owners = null;
  }

  freeStores() {
    for (const { texture } of this.stores) this.gl.deleteTexture(texture);
  }

  setMesh(mesh) {
    const { gl } = this;
    this.mesh = mesh;
    this.surface = gl.createVertexArray();
    gl.bindVertexArray(this.surface);
    const { buffers } = Object.assign(this.surface, { buffers: [] });
    const buffer = (kind, array) => {
      buffers.push(gl.createBuffer());
      gl.bindBuffer(kind, buffers.at(-1));
      gl.bufferData(kind, array, gl.STATIC_DRAW);
    };
    const attribute = (location, array, components, type) => {
      buffer(gl.ARRAY_BUFFER, array);
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, components, type, type !== gl.FLOAT, 0, 0);
    };
    [mesh.rest, mesh.positions, mesh.normals].forEach((array, location) => attribute(location, array, 3, gl.FLOAT));
    if (mesh.restNormals) attribute(6, mesh.restNormals, 3, gl.FLOAT);
    if (mesh.uv) attribute(4, mesh.uv, 2, gl.FLOAT);
    if (mesh.colors) attribute(5, mesh.colors, 3, gl.UNSIGNED_BYTE);
    gl.vertexAttrib3f(5, 1, 1, 1);
    gl.vertexAttribI4ui(7, 0, 0, 0, 0);
    if (mesh.parts) {
      buffer(gl.ARRAY_BUFFER, mesh.parts);
      gl.enableVertexAttribArray(7);
      gl.vertexAttribIPointer(7, 1, gl.UNSIGNED_INT, 0, 0);
    }
    buffer(gl.ELEMENT_ARRAY_BUFFER, mesh.triangles);
    gl.bindVertexArray(null);
  }

  // Free the vertex array of a mesh, and its buffers.
  freeSurface(surface) {
    if (!surface) return;
    this.gl.deleteVertexArray(surface);
    for (const buffer of surface.buffers) this.gl.deleteBuffer(buffer);
  }

  setSource(source) {
    this.source = source;
    source.build(this.gl);
  }

  // Create the textures of bone weights and of bones, and the vertex attribute that refers to them.
  setMotion(motion) {
    const { gl } = this;
    this.motion = motion;
    this.links = this.floatTexture(motion.links);
    this.frames = new Map(); // by animation: its texture, which is created when it is first shown
    gl.bindVertexArray(this.surface);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, motion.rangesOf(this.mesh.owners), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(3);
    gl.vertexAttribIPointer(3, 4, gl.UNSIGNED_INT, 0, 0);
    gl.bindVertexArray(null);
  }

  // Create a texture of numbers, four a texel.
  floatTexture(values) {
    const { gl } = this, rows = Math.max(Math.ceil(values.length / 4 / ROW), 1), texture = this.texture(gl.RGBA32F, rows);
    const padded = new Float32Array(4 * ROW * rows);
    padded.set(values);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, rows, gl.RGBA, gl.FLOAT, padded);
    return texture;
  }

  // Instances of cubes of the cells of a level.
  cubesAt(wanted) {
    const { gl, octree } = this, level = Math.min(wanted, octree.depth, this.deepest);
    if (this.cubes?.level === level && this.cubes.depth === octree.depth) return this.cubes;
    this.freeCubes();
    const cells = octree.cubes(level), array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, cells, gl.STATIC_DRAW);
    for (const [location, components, offset] of [[0, 4, 0], [1, 1, 16]]) {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribIPointer(location, components, gl.UNSIGNED_INT, CUBE_BYTES, offset);
      gl.vertexAttribDivisor(location, 1);
    }
    gl.bindVertexArray(null);
    return (this.cubes = { level, depth: octree.depth, array, buffer, count: cells.length / 5 });
  }

  freeCubes() {
    if (!this.cubes) return;
    this.gl.deleteBuffer(this.cubes.buffer);
    this.gl.deleteVertexArray(this.cubes.array);
    this.cubes = null;
  }
}
