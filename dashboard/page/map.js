// @ts-check
// Draws pad, vehicle and its path, from above (north up) and from the side.

const MAX_TRAIL = 1500;
const MIN_SPACING_M = 0.02;

/** @param {string} name */
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** @param {HTMLCanvasElement} canvas */
function prepared(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext('2d');
  if (!context || width === 0) return null;
  context.clearRect(0, 0, width, height);
  context.lineWidth = 1.5 * ratio;
  context.font = `${12 * ratio}px sans-serif`;
  return { context, width, height, ratio };
}

/** The width of a grid that fits, in metres. @param {number} span */
function gridStep(span) {
  const power = 10 ** Math.floor(Math.log10(span / 4));
  return [1, 2, 5, 10].map((n) => n * power).find((step) => span / step <= 6) ?? 10 * power;
}

export class Map2 {
  constructor() {
    /** @type {{ north: number, east: number, up: number }[]} */
    this.trail = [];
    /** @type {any} */
    this.vehicle = null;
    /** @type {any} */
    this.target = null;
    /** @type {{ radius_m: number, per_height: number } | null} */
    this.funnel = null;
  }

  /** @param {any} vehicle @param {any} target */
  take(vehicle, target) {
    this.vehicle = vehicle;
    this.target = target;
    if (!vehicle) return;
    const [north, east, down] = vehicle.position_m;
    const last = this.trail.at(-1);
    const moved = !last || Math.hypot(north - last.north, east - last.east, -down - last.up) > MIN_SPACING_M;
    if (moved) this.trail.push({ north, east, up: -down });
    if (this.trail.length > MAX_TRAIL) this.trail.shift();
  }

  /** @param {HTMLCanvasElement} canvas */
  drawAbove(canvas) {
    const prepare = prepared(canvas);
    if (!prepare || !this.vehicle) return;
    const { context, width, height, ratio } = prepare;
    const pad = this.target?.position_m ?? null;
    const centre = pad ?? this.vehicle.position_m;
    const far = Math.hypot(this.vehicle.position_m[0] - centre[0], this.vehicle.position_m[1] - centre[1]);
    const span = Math.max(1, 2.6 * far, 8 * (this.target?.deviation_m ?? 0));
    const scale = Math.min(width, height) / span;
    /** @param {number} north @param {number} east @returns {[number, number]} */
    const at = (north, east) => [width / 2 + (east - centre[1]) * scale, height / 2 - (north - centre[0]) * scale];
    const step = gridStep(span);
    context.strokeStyle = colour('--grid');
    context.beginPath();
    for (let n = -Math.ceil(span / step); n <= Math.ceil(span / step); n += 1) {
      const [x, y] = at(centre[0] + n * step, centre[1] + n * step);
      context.moveTo(x, 0);
      context.lineTo(x, height);
      context.moveTo(0, y);
      context.lineTo(width, y);
    }
    context.stroke();
    context.fillStyle = colour('--quiet');
    context.fillText(`grid ${step < 1 ? step.toFixed(2) : step} m, north up`, 6 * ratio, height - 6 * ratio);
    context.strokeStyle = colour('--path');
    context.globalAlpha = 0.8;
    context.beginPath();
    this.trail.forEach((point, n) => {
      const [x, y] = at(point.north, point.east);
      if (n === 0) context.moveTo(x, y);
      else context.lineTo(x, y);
    });
    context.stroke();
    context.globalAlpha = 1;
    if (pad) {
      const [x, y] = at(pad[0], pad[1]);
      context.strokeStyle = colour('--good');
      context.strokeRect(x - 7 * ratio, y - 7 * ratio, 14 * ratio, 14 * ratio);
      if (this.target.deviation_m) {
        // Three standard deviations.
        context.setLineDash([4 * ratio, 4 * ratio]);
        context.beginPath();
        context.arc(x, y, Math.max(1, 3 * this.target.deviation_m * scale), 0, 2 * Math.PI);
        context.stroke();
        context.setLineDash([]);
      }
    }
    const wind = this.target?.wind_m_s;
    if (wind && Math.hypot(wind[0], wind[1]) > 0.2) {
      const strength = Math.hypot(wind[0], wind[1]);
      const [dx, dy] = [(wind[1] / strength) * 24 * ratio, (-wind[0] / strength) * 24 * ratio];
      arrow(context, 40 * ratio - dx / 2, 40 * ratio - dy / 2, dx, dy, colour('--quiet'));
      context.fillStyle = colour('--quiet');
      context.fillText(`wind ${strength.toFixed(1)} m/s`, 70 * ratio, 22 * ratio);
    }
    const [x, y] = at(this.vehicle.position_m[0], this.vehicle.position_m[1]);
    const heading = this.vehicle.heading_rad;
    context.fillStyle = colour('--text');
    context.beginPath();
    for (const [angle, far] of [[0, 12], [2.5, 9], [Math.PI, 4], [-2.5, 9]]) {
      context.lineTo(x + Math.sin(heading + angle) * far * ratio, y - Math.cos(heading + angle) * far * ratio);
    }
    context.fill();
  }

  /** @param {HTMLCanvasElement} canvas */
  drawSide(canvas) {
    const prepare = prepared(canvas);
    if (!prepare || !this.vehicle) return;
    const { context, width, height, ratio } = prepare;
    const pad = this.target?.position_m ?? [0, 0, 0];
    const points = this.trail.map((it) => ({ distance: Math.hypot(it.north - pad[0], it.east - pad[1]), up: it.up + pad[2] }));
    const high = points.reduce((a, it) => Math.max(a, it.up), 1) * 1.1;
    const far = points.reduce((a, it) => Math.max(a, it.distance), 0.3) * 1.1;
    /** @param {{ distance: number, up: number }} it @returns {[number, number]} */
    const at = (it) => [30 * ratio + (it.distance / far) * (width - 40 * ratio), height - 20 * ratio - (it.up / high) * (height - 30 * ratio)];
    context.strokeStyle = colour('--grid');
    context.fillStyle = colour('--quiet');
    const step = gridStep(high);
    for (let up = 0; up <= high; up += step) {
      const [, y] = at({ distance: 0, up });
      context.beginPath();
      context.moveTo(30 * ratio, y);
      context.lineTo(width, y);
      context.stroke();
      context.fillText(`${up < 1 && up > 0 ? up.toFixed(1) : up.toFixed(0)}`, 4 * ratio, y + 4 * ratio);
    }
    const label = `m up; ${far.toFixed(2)} m across`;
    context.fillText(this.funnel ? `${label}; dashed: funnel` : label, 34 * ratio, height - 5 * ratio);
    if (this.funnel) {
      // Left of it the vehicle may descend.
      context.strokeStyle = colour('--quiet');
      const { radius_m, per_height } = this.funnel;
      const foot = at({ distance: radius_m, up: 0 });
      const top = at({ distance: radius_m + per_height * high, up: high });
      context.setLineDash([4 * ratio, 4 * ratio]);
      context.beginPath();
      context.moveTo(...foot);
      context.lineTo(...top);
      context.stroke();
      context.setLineDash([]);
    }
    context.strokeStyle = colour('--path');
    context.beginPath();
    points.forEach((it, n) => {
      const [x, y] = at(it);
      if (n === 0) context.moveTo(x, y);
      else context.lineTo(x, y);
    });
    context.stroke();
    const last = points.at(-1);
    if (last) {
      const [x, y] = at(last);
      context.fillStyle = colour('--text');
      context.beginPath();
      context.arc(x, y, 5 * ratio, 0, 2 * Math.PI);
      context.fill();
    }
  }
}

/** @param {CanvasRenderingContext2D} context @param {number} x @param {number} y @param {number} dx @param {number} dy @param {string} ink */
function arrow(context, x, y, dx, dy, ink) {
  context.strokeStyle = ink;
  context.beginPath();
  context.moveTo(x, y);
  context.lineTo(x + dx, y + dy);
  context.lineTo(x + dx * 0.7 - dy * 0.2, y + dy * 0.7 + dx * 0.2);
  context.moveTo(x + dx, y + dy);
  context.lineTo(x + dx * 0.7 + dy * 0.2, y + dy * 0.7 - dx * 0.2);
  context.stroke();
}
