// How fine pictures are: what moves is drawn as coarsely as the browser needs to keep up, what stands still is drawn whole.

const SLOW = 40; // [ms] between two pictures, above which they are drawn coarser
const OFTEN = 4; // such pictures in a row
const REST = 250; // [ms] after which what stands still is drawn whole
const COARSEST = 3;

/** Says in which frames to draw. */
export class Pace {
  /** @param {{ level: number }} drawing whose level says how coarse it is */
  constructor(drawing) {
    this.drawing = drawing;
    this.level = 0; // of pictures that move
    this.slow = 0;
    this.moving = false;
    this.since = this.last = 0; // [ms]
  }

  /**
   * Whether a picture is drawn in this frame, and how coarse.
   * @param {number} now [ms]
   * @param {boolean} changed whether there is anything new in it
   */
  draws(now, changed) {
    const { drawing } = this, passed = now - this.last;
    this.last = now;
    if (changed) {
      this.slow = this.moving && passed > SLOW ? this.slow + 1 : 0;
      if (this.slow >= OFTEN) {
        this.level = Math.min(this.level + 1, COARSEST);
        this.slow = 0;
      }
      this.moving = true;
      this.since = now;
      drawing.level = this.level;
      return true;
    }
    if (!this.moving || now - this.since < REST) return false;
    this.moving = false;
    const fine = drawing.level === 0;
    drawing.level = 0;
    this.level = Math.max(0, this.level - 1); // what was slow for a while may be fast again
    return !fine;
  }
}
