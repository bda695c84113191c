// @ts-check
// Pictures beside the page's own thread, so that neither waits for the other, also in a hidden tab.
import { follow } from './picture.js';

self.onmessage = (event) => {
  const { canvas, address } = event.data;
  follow(canvas, address, (message) => self.postMessage(message));
};
