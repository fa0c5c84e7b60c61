// A texture and its mesh: of a set, one of several. What the GPU holds of them.

import { MORE, Octree, ROW } from "./octree.js";
import { patch } from "./patch.js";

const PIECES = 20; // milliseconds of a picture in which cells become cubes

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
    return this.octree.deepestIn(this.mostRows);
  }

  // The lowest and the highest corner of what is drawn.
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

  // Whether some of it may be translucent, as far as its data has come.
  get hasAlpha() {
    return this.octree.depth >= 0 && this.channel("alpha")?.components === 1;
  }

  channel(name) {
    return this.header.channels.find((channel) => channel.name === name);
  }

  // Make everything anew, as after a lost context.
  build(gl) {
    const { octree } = this;
    this.gl = gl;
    this.buildTree();
    const last = octree.tables.kept + octree.tables.split ? octree.planes[0].length / 4 : octree.cells[octree.depth + 1];
    const entries = [0, octree.entries.length / 2];
    if (octree.depth >= 0) this.upload({ nodes: [0, octree.nodes[octree.depth]], cells: [0, last], entries });
    if (this.mesh) this.takeMesh(this.mesh);
    if (this.motion && this.mesh.owners) this.takeMotion(this.motion);
    this.source?.build(gl);
    this.cubes = null;
  }

  // What the GPU holds of the octree: textures of words, of tables, and one of a layer a plane for those that are sRGB,
  // and for the others.
  buildTree() {
    const { gl, octree } = this, { planes } = octree.header, two = [gl.RG_INTEGER, gl.UNSIGNED_INT], four = [gl.RGBA, gl.UNSIGNED_BYTE];
    const store = (name, size, format, known, read, kind = gl.TEXTURE_2D) => ({ name, size, format, known, read, kind, texture: null, rows: 0 });
    const layered = (name, format, isSrgb) => store(name, 4, format, four, () => octree.planes.filter((_, n) => planes[n] === isSrgb), gl.TEXTURE_2D_ARRAY);
    const all = [store("u_nodes", 2, gl.RG32UI, two, () => [octree.words]), store("u_entries", 2, gl.RG32UI, two, () => [octree.entries])];
    all.push(layered("u_srgb", gl.SRGB8_ALPHA8, true), layered("u_linear", gl.RGBA8, false));
    this.stores = all.filter((each) => each.read().length);
    for (const each of this.stores) this.allocate(each);
  }

  // The arrays that textures hold, with their rows.
  get held() {
    return this.stores.flatMap(({ read, size, rows }) => read().map((array) => ({ array, size, rows })));
  }

  // Make a texture for arrays, with room for a part more.
  allocate(store, more = 0) {
    const arrays = store.read();
    store.rows = Math.min(Math.ceil((arrays[0].length / (store.size * ROW)) * (1 + more)), this.mostRows);
    store.texture = this.texture(store.format, store.rows, store.kind === this.gl.TEXTURE_2D ? 0 : arrays.length);
  }

  get mostRows() {
    return this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE);
  }

  // A texture of rows, or of several layers of them.
  texture(format, rows, layers = 0) {
    const { gl } = this, texture = gl.createTexture(), kind = layers ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D;
    gl.bindTexture(kind, texture);
    if (layers) gl.texStorage3D(kind, 1, format, ROW, rows, layers);
    else gl.texStorage2D(kind, 1, format, ROW, rows);
    gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  // Send the rows from one up to another; returns how many.
  send({ read, size, known, kind, texture, rows }, begin, end) {
    const { gl } = this, count = Math.min(end, rows) - begin, arrays = read();
    if (count <= 0) return 0;
    gl.bindTexture(kind, texture);
    arrays.forEach((array, layer) => {
      const part = array.subarray(size * ROW * begin, size * ROW * (begin + count));
      if (kind === gl.TEXTURE_2D) gl.texSubImage2D(kind, 0, 0, begin, ROW, count, ...known, part);
      else gl.texSubImage3D(kind, 0, 0, begin, layer, ROW, count, 1, ...known, part);
    });
    return count * arrays.length;
  }

  // Send the rows that hold some nodes and cells.
  upload({ nodes, cells, entries = [0, 0] }) {
    for (const store of this.stores) {
      const [first, end] = { u_nodes: nodes, u_entries: entries }[store.name] ?? cells;
      this.send(store, Math.floor(first / ROW), Math.ceil(end / ROW));
    }
  }

  // Take a change of the octree: only rows that differ are sent. Textures that get too small are made anew, with room
  // for what comes next. `added` are values of channels that it did not have, if the channels are others. Returns how many
  // rows were sent.
  change(header, counts, bytes, added) {
    const { octree } = this;
    if (added) {
      octree.relayout(header, added);
      Object.assign(this.header, { channels: header.channels, area: header.area, flags: header.flags, planes: header.planes });
      this.free();
      this.buildTree();
    }
    const { nodes, entries, cells } = patch(octree, header, counts, bytes);
    octree.header = Object.assign(this.header, header);
    let sent = 0;
    for (const store of this.stores) {
      const marks = { u_nodes: nodes, u_entries: entries }[store.name] ?? cells;
      const rows = Math.min(marks.length, this.mostRows), isSmall = rows > store.rows, fits = !isSmall && !added;
      if (isSmall) {
        this.gl.deleteTexture(store.texture);
        this.allocate(store, MORE);
      }
      for (let begin = 0, end; begin < rows; begin = end + 1) {
        for (end = begin; end < rows && (!fits || marks[end]); ) end++;
        sent += this.send(store, begin, end);
      }
    }
    this.cubes = null;
    return sent;
  }

  // Keep nothing but what the GPU has: it is only looked up.
  keepOnGpu() {
    const { octree } = this;
    octree.words = octree.planes = octree.owners = null;
  }

  free() {
    for (const { texture } of this.stores) this.gl.deleteTexture(texture);
  }

  takeMesh(mesh) {
    const { gl } = this;
    this.mesh = mesh;
    this.surface = gl.createVertexArray();
    gl.bindVertexArray(this.surface);
    const { buffers } = Object.assign(this.surface, { buffers: [] }), buffer = (kind, array) => {
      buffers.push(gl.createBuffer());
      gl.bindBuffer(kind, buffers.at(-1));
      gl.bufferData(kind, array, gl.STATIC_DRAW);
    };
    const attribute = (place, array, components, type) => {
      buffer(gl.ARRAY_BUFFER, array);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, components, type, type !== gl.FLOAT, 0, 0);
    };
    [mesh.rest, mesh.positions, mesh.normals].forEach((array, place) => attribute(place, array, 3, gl.FLOAT));
    if (mesh.upright) attribute(6, mesh.upright, 3, gl.FLOAT);
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

  // Forget a mesh that was laid flat.
  freeMesh(surface) {
    if (!surface) return;
    this.gl.deleteVertexArray(surface);
    for (const buffer of surface.buffers) this.gl.deleteBuffer(buffer);
  }

  takeSource(source) {
    this.source = source;
    source.build(this.gl);
  }

  // Take what moves the mesh: a texel an entry of its vertices, and of each animation one a row of a bone.
  takeMotion(motion) {
    const { gl } = this;
    this.motion = motion;
    this.links = this.numbers(motion.links);
    this.frames = new Map();
    gl.bindVertexArray(this.surface);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, motion.linksOf(this.mesh.owners), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(3);
    gl.vertexAttribIPointer(3, 4, gl.UNSIGNED_INT, 0, 0);
    gl.bindVertexArray(null);
  }

  // A texture of numbers, four in a texel.
  numbers(values) {
    const { gl } = this, rows = Math.max(Math.ceil(values.length / 4 / ROW), 1), made = this.texture(gl.RGBA32F, rows);
    const padded = new Float32Array(4 * ROW * rows);
    padded.set(values);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, rows, gl.RGBA, gl.FLOAT, padded);
    return made;
  }

  // The cells of a level as cubes: those that are ready, and more of them at each call.
  cubesAt(wanted) {
    const { gl, octree } = this, level = Math.min(wanted, octree.depth, this.deepest);
    if (this.cubes?.level !== level || this.cubes.depth !== octree.depth) this.beginCubes(level);
    const { cubes } = this, end = performance.now() + PIECES;
    if (cubes.isComplete) return cubes;
    const before = cubes.count;
    while (!cubes.isComplete && performance.now() < end) {
      const { value, done } = cubes.pieces.next();
      cubes.isComplete = done;
      cubes.count = value ?? cubes.count;
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, cubes.buffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 20 * before, cubes.cells.subarray(5 * before, 5 * cubes.count));
    if (cubes.isComplete) cubes.cells = null;
    return cubes;
  }

  beginCubes(level) {
    const { gl, octree } = this;
    if (this.cubes) {
      gl.deleteBuffer(this.cubes.buffer);
      gl.deleteVertexArray(this.cubes.array);
    }
    const cells = new Uint32Array(5 * octree.countAt(level)), array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, cells.byteLength, gl.STATIC_DRAW);
    for (const [place, components, offset] of [[0, 4, 0], [1, 1, 16]]) {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribIPointer(place, components, gl.UNSIGNED_INT, 20, offset);
      gl.vertexAttribDivisor(place, 1);
    }
    gl.bindVertexArray(null);
    const pieces = octree.cubes(level, cells);
    this.cubes = { level, depth: octree.depth, array, buffer, cells, pieces, count: 0, isComplete: false };
  }
}
