// What this computer's graphics can show smoothly.

const ON_A_CARD = 1_000_000;
const IN_SOFTWARE = 100_000;

/** Points of a cloud to show: few where the browser draws without a graphics card. */
export function pointsShown() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (context === null) return IN_SOFTWARE;
  const details = context.getExtension("WEBGL_debug_renderer_info");
  const renderer = String(context.getParameter(details?.UNMASKED_RENDERER_WEBGL ?? context.RENDERER));
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(renderer) ? IN_SOFTWARE : ON_A_CARD;
}
