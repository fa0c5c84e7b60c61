import type { BufferGeometry, Group, Loader, Material, Mesh, MeshStandardMaterial, Object3D } from "three";

export type Filter = "nearest" | "linear" | "quadratic";

/** An octree texture, which materials look up by positions at rest. */
export class OctreeTexture {
  /** What the file says of it: depth, origin and size of the root cell, channels. */
  readonly header: { depth: number; origin: [number, number, number]; size: number; channels: { name: string; components: number }[] };
  /** Its mesh, if the file has one. */
  readonly mesh: Mesh<BufferGeometry, MeshStandardMaterial> | null;
  /** How cells are blended. Default: "quadratic". */
  filter: Filter;
  /** The deepest level that is looked up. Default: all. */
  level: number;
  /** Whether each pixel averages over what it covers. Default: true. */
  footprints: boolean;
  /** Have a material take its channels from this texture instead of its own maps and values; returns the material. */
  applyTo<T extends Material>(material: T): T;
  /** Give the meshes of an object positions at rest, as it stands now, and materials of this texture: clones of its own by default. */
  applyToObject(object: Object3D, material?: (own: Material) => Material): void;
  dispose(): void;
}

/** What a web file holds. */
export interface Loaded {
  textures: OctreeTexture[];
  /** The meshes of the textures; null if the file has none. */
  group: Group | null;
  /** Resolves when the finest levels are there. */
  complete: Promise<void>;
}

/** Reads web files, NAME.octw, coarse levels first. */
export class OctreeTextureLoader extends Loader<Loaded> {
  /** Take a web file that is in memory. */
  parseBuffer(buffer: ArrayBuffer, name?: string): Promise<Loaded>;
}

/** EXT_octree_texture for GLTFLoader: `loader.register((parser) => new GLTFOctreeTexture(parser))`. */
export class GLTFOctreeTexture {
  readonly name: "EXT_octree_texture";
  constructor(parser: object);
  /** Textures the primitives that have the extension; gives the glTF `octrees`. */
  afterRoot(gltf: object): Promise<void>;
}

/** An entry of `octrees` of a glTF that was read so. */
export interface GLTFOctree {
  texture: OctreeTexture;
  /** Resolves when the finest levels are there. */
  complete: Promise<void>;
}
