/** Data embedded in the page by `globalsplat view`. */

const text = (id) => document.getElementById(id).textContent;

/** Cameras, the camera path through them, and the scene's orientation and scale. */
export const scene = JSON.parse(text("scene"));

/** Returns the bytes of the SPZ file. */
export const splat = () => Uint8Array.fromBase64?.(text("splat")) ?? Uint8Array.from(atob(text("splat")), (c) => c.charCodeAt(0));
