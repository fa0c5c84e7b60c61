// Octree textures as nodes of TSL, for WebGPURenderer: as WGSL, or as GLSL where it draws by WebGL2.

import { Node } from "three/webgpu";
import {
  attribute, code, faceDirection, Fn, normalFlat, normalLocal, normalView, positionView, reference, select, texture as bound,
  transformNormalToView, varying, vec2,
} from "three/tsl";
import { withEachPlane, channelSum } from "../page/walk.js";
import { wgslOf } from "./wgsl.js";

const NODES = {
  base_color: "colorNode", roughness: "roughnessNode", metallic: "metalnessNode", emissive: "emissiveNode", occlusion: "aoNode",
  normal: "normalNode",
};
const UNIFORMS = { u_kept: "vec3", u_split: "vec3", u_keptLevel: "float", u_leafRoot: "float", u_depth: "float", u_footprints: "float" };
// The lookup; functions of channels follow it. Cell numbers are exact in floats: they have at most 24 bits.
const LOOKUP = `
float octexLookUp(vec3 rest, vec3 side, vec3 kept, vec3 split, float keptLevel, float leafRoot, float depth, float footprints) {
#if defined(SPLIT) || defined(KEPT)
  u_kept = uvec3(kept);
  u_split = uvec3(split);
  u_keptLevel = int(keptLevel);
#endif
  u_leafRoot = leafRoot > 0.5;
  u_depth = int(depth);
#ifdef FACING
  face(side);
#endif
  lookUp(rest, footprints * footprint(rest));
  return g_cover;
}

float octex_alpha(float lookup) {
  return g_alpha;
}
`;

// A call of a shader function. A channel's function has the lookup as its first input, so that it is built before.
class Call extends Node {
  constructor(type, name, inputs) {
    super(type);
    Object.assign(this, { name, inputs });
  }

  generate(builder) {
    return `${this.name}(${this.inputs.map((each) => each.build(builder)).join(", ")})`;
  }
}

class Lookup extends Call {
  constructor(octree, names, inputs) {
    super("float", "octexLookUp", inputs);
    this.textures = octree.stores.filter(([name]) => octree.uniforms[name]).map(([name]) => {
      const { value } = octree.uniforms[name];
      value.internalFormat = null; // WebGPU's names differ
      return bound(value, vec2(0)).setName(name);
    });
    Object.assign(this, { octree, names });
  }

  generate(builder) {
    const { backend } = builder.renderer, { octree } = this, isWebGl = Boolean(backend.isWebGLBackend);
    octree.checkSize(isWebGl ? backend.gl.getParameter(backend.gl.MAX_TEXTURE_SIZE) : backend.device.limits.maxTextureDimension2D);
    for (const each of this.textures) each.build(builder, "texture");
    const text = this.text();
    code(isWebGl ? text.replace(/^uniform .*sampler.*$/gm, "").replace(/^uniform /gm, "") : wgslOf(text)).build(builder);
    return super.generate(builder);
  }

  text() {
    const { octree, names } = this, defines = octree.defines(names).join("\n"), planes = Number(/PLANES (\d+)/.exec(defines)[1]);
    const sums = names.map((name) => `vec3 octex_${name}(float lookup) {\n  return vec3(${channelSum(octree.channel(name))});\n}`);
    const normal = "vec3 octexNormal(float lookup, vec3 rest, vec3 side, vec3 position, vec3 normal) {\n  return shownNormal(2.0 * (NORMAL) - 1.0, side, rest, position, normal);\n}";
    return [defines, withEachPlane(octree.walk + LOOKUP, planes), ...sums, ...(names.includes("normal") ? [normal] : [])].join("\n");
  }
}

// 1 where the camera sees the side of the normal, else −1. Three's own faceDirection is wrong for mirrored instances.
const visibleSide = Fn((builder) => {
  if (!builder.hasGeometryAttribute("normal")) return faceDirection;
  return select(varying(transformNormalToView(normalLocal)).dot(normalFlat).lessThan(0), -1, 1);
});

// Replace a material's own maps and values by the channels of a texture with its current filter; returns the material.
export function applyNodes(octree, material) {
  const rest = varying(attribute("octexRest", "vec3")), side = varying(attribute("octexNormal", "vec3")).normalize().mul(visibleSide());
  const uniforms = Object.entries(UNIFORMS).map(([name, type]) => reference("value", type, octree.uniforms[name]));
  const names = octree.clearFields(material);
  const lookup = new Lookup(octree, names, [rest, side, ...uniforms]).toVar();
  for (const name of names) {
    const value = new Call("vec3", `octex_${name}`, [lookup]);
    material[NODES[name]] = ["base_color", "emissive"].includes(name) ? value : value.x;
    if (name === "normal") material.normalNode = new Call("vec3", "octexNormal", [lookup, rest, side, positionView, normalView]);
  }
  if (octree.channel("alpha")) material.opacityNode = new Call("float", "octex_alpha", [lookup]);
  // For materials other than node materials, three uses this alone as the program's key.
  const key = material.customProgramCacheKey;
  material.customProgramCacheKey = () => `${key.call(material)} ${lookup.id}`;
  material.needsUpdate = true;
  return material;
}
