// Draws what has changed, all of it at once and at most thirty times a second. A frame costs about the same however much of it moves, and
// where no graphics card paints it, it takes its time from the sound. What is dragged is drawn elsewhere, at once.

const LEAST_MS = 30; // between two frames: on a screen of sixty frames a second that leaves out every other one

const waiting = new Set();
let drawnAt = -Infinity;
let isAsked = false;

/** Calls `draw` in the next frame, once however often it is asked for until then. */
export function inNextFrame(draw) {
  waiting.add(draw);
  if (isAsked) return;
  isAsked = true;
  setTimeout(() => requestAnimationFrame(drawAll), Math.max(0, drawnAt + LEAST_MS - performance.now()));
}

function drawAll() {
  drawnAt = performance.now();
  isAsked = false;
  const draws = [...waiting];
  waiting.clear();
  for (const draw of draws) {
    try {
      draw();
    } catch (error) {
      reportError(error); // the others are drawn all the same
    }
  }
}
