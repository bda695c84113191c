// @ts-check
// Draws pictures in a thread of its own, so that neither it nor the page waits for the other, also in a hidden tab.
import { follow } from './picture.js';

/** @type {import('./picture.js').Follower | null} */
let follower = null;

self.onmessage = (event) => {
  const { canvas, address, reconnect, showRefused } = event.data;
  if (canvas) follower = follow(canvas, address, (message) => self.postMessage(message));
  if (reconnect) follower?.reconnect();
  if (showRefused !== undefined) follower?.showRefused(showRefused);
};
