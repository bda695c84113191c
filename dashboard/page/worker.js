// @ts-check
// Pictures beside the page's own thread, so that neither waits for the other, also in a hidden tab.
import { follow } from './picture.js';

/** @type {(() => void) | null} */
let again = null;

self.onmessage = (event) => {
  const { canvas, address } = event.data;
  if (canvas) again = follow(canvas, address, (message) => self.postMessage(message));
  else again?.();
};
