"""Reads back the pictures that a page draws: frames.py URL SECONDS FRAMES [TOKEN]

Each frame has its number in its pixels, and a square whose position follows from it (`tests/dashboard/film.rs`). The page's canvas is
read until so many different frames were drawn or the time is over: the number, and which overlay is drawn where. The times at which the server
sent each picture and at which its pixels can be read on the page are compared by the clock that all processes of a machine share.
Prints the measurements as JSON on its last line. Exit status 77: no browser, or no package to drive one.
"""

import json
import statistics
import sys
import time

from chromium import CHROMIUM, sync_playwright

URL, SECONDS, FRAMES = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
TOKEN = sys.argv[4] if len(sys.argv) > 4 else None
PATIENCE_S = 60

# Notes the page's message on each drawn picture: its number, when it was made and taken (ms of the server's clock), and when this message came.
LISTEN = """
window.drawn = new Map();
const Plain = window.Worker;
window.Worker = class extends Plain {
  constructor(...args) {
    super(...args);
    this.addEventListener('message', ({ data }) => {
      if (data.kind !== 'drawn') return;
      const { sequence, shown_ms, taken_ms, found_sequence, width, height } = data.header;
      window.size = [width, height];
      window.drawn.set(sequence & 0xffff, { shown: shown_ms, taken: taken_ms, at: performance.now(), sequence, found_sequence });
    });
  }
};
"""

# Begins to read the canvas at each refresh, until so many frames were seen. The overlay is looked for where `withOverlay` is set.
READ = """([frames, withOverlay]) => {
  const video = document.getElementById('video');
  const strip = document.createElement('canvas');
  [strip.width, strip.height] = [18 * 24, 48];
  const pixels = strip.getContext('2d', { willReadFrequently: true });
  const whole = document.createElement('canvas').getContext('2d', { willReadFrequently: true });
  window.seen = [];
  const numbers = new Set();

  /** The number in the pixels: 16 blocks between a white and a black one, and below all of them inverted. */
  const numberIn = (data) => {
    const grey = (n, row) => data[((12 + 24 * row) * strip.width + 24 * n + 12) * 4];
    if (grey(0, 0) < 160 || grey(17, 0) > 90) return null;
    let number = 0;
    for (let n = 0; n < 16; n += 1) {
      const [up, down] = [grey(1 + n, 0) > 128, grey(1 + n, 1) > 128];
      if (up === down) return null;
      number |= up ? 1 << n : 0;
    }
    return number;
  };
  /** How far a pixel is from grey: towards green as the overlay of the detector in use is, or towards yellow as another one's. */
  const coloured = (data, at) => Math.max(data[at], data[at + 1]) - data[at + 2] > 40 ? data[at + 1] - data[at + 2] : 0;
  /** The centre of the coloured pixels on a line through (x, y), from 7 pixels before to 7 behind; null where there are none. */
  const centre = (image, x, y, [dx, dy]) => {
    let [sum, weighted] = [0, 0];
    for (let step = -7; step <= 7; step += 1) {
      const weight = coloured(image.data, ((y + step * dy) * image.width + x + step * dx) * 4);
      sum += weight;
      weighted += weight * step;
    }
    return sum > 0 ? weighted / sum : null;
  };
  const overlay = (image, number) => {
    const [x, y, size] = [60 + (number * 53) % 200, 110 + (number * 31) % 200, 80];
    const inside = (left, u, v) => u >= left - 8 && u < left + size + 190 && v >= y - 8 && v < y + size + 8;
    // The overlay of this frame is there, by the detector in use, or 40 pixels further to the right by the other one, or nowhere.
    const found = [0, 40].map((shift) => {
      const left = x + shift;
      const offsets = [
        centre(image, left, y + 20, [1, 0]), centre(image, left + 20, y, [0, 1]),
        centre(image, left + size, y + 20, [1, 0]), centre(image, left + 20, y + size, [0, 1]),
      ];
      // The line lies on the boundary of two pixels.
      return offsets.includes(null) ? null : Math.max(...offsets.map((it) => Math.abs(it + 0.5)));
    });
    let elsewhere = 0;
    const which = found[0] !== null ? 0 : 40;
    for (let v = 0; v < image.height; v += 1) {
      for (let u = 0; u < image.width; u += 1) {
        const is = coloured(image.data, (v * image.width + u) * 4) > 0;
        if (is && (found.every((it) => it === null) || !inside(x + which, u, v))) elsewhere += 1;
      }
    }
    // The picture lies on the canvas to the pixel: its last block ends where it must, to the right and below.
    const grey = (u, v) => image.data[(v * image.width + u) * 4];
    const isInPlace = grey(431, 12) < 60 && grey(432, 12) > 80 && grey(420, 47) < 60 && grey(420, 48) > 80;
    return { used: found[0], spare: found[0] === null ? found[1] : null, elsewhere, isInPlace };
  };
  const look = () => {
    if (numbers.size >= frames) return;
    requestAnimationFrame(look);
    // As large as the picture is, so that no pixel is scaled.
    const [width, height] = window.size;
    pixels.drawImage(video, 0, 0, width, height);
    const number = numberIn(pixels.getImageData(0, 0, strip.width, strip.height).data);
    const at = performance.now();
    if (number === null) { window.unreadable = (window.unreadable ?? 0) + 1; return; }
    if (numbers.has(number)) return;
    numbers.add(number);
    const entry = { number, at };
    if (withOverlay) {
      [whole.canvas.width, whole.canvas.height] = [width, height];
      whole.drawImage(video, 0, 0, width, height);
      const image = whole.getImageData(0, 0, width, height);
      // Another frame was drawn meanwhile.
      const again = numberIn(whole.getImageData(0, 0, strip.width, strip.height).data);
      if (again !== number) { numbers.delete(number); return; }
      Object.assign(entry, overlay(image, number));
    }
    window.seen.push(entry);
  };
  requestAnimationFrame(look);
}"""


def offset_ms(page):
    """The machine's clock less the page's, and how well that is known, in milliseconds."""
    best = None
    for _ in range(60):
        before = time.monotonic()
        at = page.evaluate("performance.now()")
        after = time.monotonic()
        if best is None or after - before < best[0]:
            best = (after - before, (before + after) / 2 * 1e3 - at)
    return best[1], best[0] * 1e3 / 2


def quantiles(values):
    values = sorted(values)
    return {"p50": round(values[len(values) // 2], 1), "p99": round(values[int(0.99 * (len(values) - 1))], 1), "max": round(values[-1], 1)}


def slope_per_min(times_ms, values):
    """By how much the values grow in a minute, by the median slope of all pairs of tenths: single late ones do not count."""
    tenth = max(1, len(values) // 10)
    parts = [(statistics.median(times_ms[at : at + tenth]), statistics.median(values[at : at + tenth])) for at in range(0, len(values) - tenth + 1, tenth)]
    slopes = [(b[1] - a[1]) / (b[0] - a[0]) * 60e3 for n, a in enumerate(parts) for b in parts[n + 1 :]]
    return round(statistics.median(slopes), 2) if slopes else None


def main():
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1440, "height": 1150})
        page.add_init_script(LISTEN)
        page.goto(URL)
        if TOKEN:
            page.locator("#token").wait_for(state="visible")
            page.locator("#token").fill(TOKEN)
            page.locator("#login button").click()
        until = time.monotonic() + PATIENCE_S
        while not page.evaluate("window.drawn.size > 5"):
            assert time.monotonic() < until, "no picture is drawn"
            time.sleep(0.1)
        offset, error = offset_ms(page)
        page.evaluate(READ, [FRAMES, SECONDS <= 0])
        began = time.monotonic()
        limit = SECONDS if SECONDS > 0 else 20 * PATIENCE_S
        while time.monotonic() - began < limit and page.evaluate("window.seen.length") < FRAMES:
            time.sleep(0.5)
        took_s = time.monotonic() - began
        drift = offset_ms(page)[0] - offset
        seen, drawn, unreadable = page.evaluate("[window.seen, [...window.drawn], window.unreadable ?? 0]")
        browser.close()
    drawn = dict(drawn)
    measured = {"frames": len(seen), "seconds": round(took_s, 1), "unreadable": unreadable}
    if SECONDS <= 0:
        assert all(it["isInPlace"] for it in seen), "a picture is not where its pixels must be"
        measured |= {
            "with_overlay": sum(it["used"] is not None for it in seen),
            "of_another_detector": sum(it["spare"] is not None for it in seen),
            "bare": sum(it["used"] is None and it["spare"] is None for it in seen),
            "coloured_elsewhere": sum(it["elsewhere"] > 0 for it in seen),
            "corner_max_px": round(max((it["used"] if it["used"] is not None else it["spare"] or 0.0) for it in seen), 2),
            "of_another_frame": sum(it["found_sequence"] not in (None, it["sequence"]) for it in drawn.values()),
        }
    else:
        known = [(it["at"], drawn[it["number"]]) for it in seen if it["number"] in drawn]
        readable = [at + offset - it["shown"] for at, it in known]
        measured |= {
            "rate_hz": round(len(seen) / took_s, 1),
            "clock_known_to_ms": round(error, 2),
            "clock_drift_ms": round(drift, 2),
            "sent_to_reported_ms": quantiles([it["at"] + offset - it["shown"] for it in drawn.values()]),
            "sent_to_readable_ms": quantiles(readable),
            "light_to_readable_ms": quantiles([at + offset - it["taken"] for at, it in known]),
            "growth_ms_per_min": slope_per_min([at for at, _ in known], readable),
        }
    print(json.dumps(measured))


main()
