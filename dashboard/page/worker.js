// @ts-check
// Pictures beside the page's own thread, so that neither waits for the other, also in a hidden tab.
import { follow } from './picture.js';

/** @type {import('./picture.js').Follower | null} */
let follower = null;

self.onmessage = (event) => {
  const { canvas, address, again, curious } = event.data;
  if (canvas) follower = follow(canvas, address, (message) => self.postMessage(message));
  if (again) follower?.again();
  if (curious !== undefined) follower?.curious(curious);
};
