// @ts-check
// Draws numbers over the last minute.

const SPAN_MS = 60000;
const MAX_POINTS = 1200;

/** @param {string} name */
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** A strip of one number over time. */
export class Strip {
  /** @param {HTMLElement} parent @param {string} title @param {string} unit @param {number} digits @param {number} minMax @param {number} staleMs */
  constructor(parent, title, unit, digits, minMax, staleMs) {
    /** @type {{ at: number, value: number | null }[]} */
    this.points = [];
    this.unit = unit;
    this.digits = digits;
    this.minMax = minMax;
    this.staleMs = staleMs;
    const box = document.createElement('div');
    box.className = 'strip';
    const line = document.createElement('p');
    const name = document.createElement('span');
    name.textContent = title;
    this.text = document.createElement('span');
    line.append(name, this.text);
    this.canvas = document.createElement('canvas');
    this.canvas.setAttribute('role', 'img');
    this.canvas.setAttribute('aria-label', `${title} over the last minute`);
    box.append(line, this.canvas);
    parent.append(box);
  }

  /** Adds a number, or a gap. @param {number} at @param {number | null | undefined} value */
  add(at, value) {
    this.points.push({ at, value: value ?? null });
    while (this.points.length > MAX_POINTS || (this.points[0] && this.points[0].at < at - SPAN_MS)) this.points.shift();
  }

  /** @param {number} now */
  draw(now) {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const context = canvas.getContext('2d');
    if (!context || width === 0) return;
    context.clearRect(0, 0, width, height);
    const values = this.points.flatMap((point) => (point.value === null ? [] : [point.value]));
    const max = values.reduce((a, b) => Math.max(a, b), this.minMax);
    // A number without a newer one in time is not shown.
    const newest = this.points.at(-1);
    const last = newest && now - newest.at <= this.staleMs ? newest.value : null;
    this.text.textContent = `${last == null ? '-' : last.toFixed(this.digits)} ${this.unit} (to ${max.toFixed(this.digits)})`;
    context.strokeStyle = colour('--grid');
    context.lineWidth = 1;
    context.beginPath();
    for (const part of [0.25, 0.5, 0.75]) {
      context.moveTo(0, part * height);
      context.lineTo(width, part * height);
    }
    context.stroke();
    context.strokeStyle = colour('--path');
    context.lineWidth = 1.5 * ratio;
    context.beginPath();
    let isDown = false;
    for (const { at, value } of this.points) {
      if (value === null) {
        isDown = false;
        continue;
      }
      const x = width * (1 - (now - at) / SPAN_MS);
      const y = height - (value / max) * (height - 4) - 2;
      if (isDown) context.lineTo(x, y);
      else context.moveTo(x, y);
      isDown = true;
    }
    context.stroke();
  }
}
