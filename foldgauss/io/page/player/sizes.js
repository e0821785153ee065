// How many Gaussians an edit makes of a segment, from its steps alone: of segments that are not decoded.
import { fromRanges } from "./indices.js";
import { checkTotal } from "./operations.js";

/** Throw an Error for display where steps make too many of a segment's `num` Gaussians. */
export function checkSize(steps, number, num) {
  let total = new Float64Array(num).fill(1), selected = new Float64Array(num); // of each: itself and its copies; those selected
  for (const step of steps) {
    if (step.select) {
      const mask = fromRanges(step.select[number] ?? "", num);
      selected = total.map((own, i) => own * mask[i]);
    } else if (step.do === "vanish" || step.factor === 0) {
      total = total.map((own, i) => own - selected[i]);
      selected = new Float64Array(num);
    } else if (step.do === "multiply") {
      const added = selected.map((own) => own * step.offsets.length);
      total = total.map((own, i) => own + added[i]);
      selected = step.originals ? selected.map((own, i) => own + added[i]) : added;
      checkTotal(total.reduce((sum, own) => sum + own, 0));
    }
  }
}
