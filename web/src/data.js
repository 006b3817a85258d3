/** What the page was written with. */

const text = (id) => document.getElementById(id).textContent;

/** Cameras, the path through them, and how the scene lies. */
export const scene = JSON.parse(text("scene"));

/** The bytes of the SPZ. */
export const splat = () => Uint8Array.fromBase64?.(text("splat")) ?? Uint8Array.from(atob(text("splat")), (c) => c.charCodeAt(0));
