// @ts-check
// Buttons that command only when they are held for a second, by pointer or space bar.
//
// The nonce is requested when the button is pressed, so the server itself measures how long it was held.

/** Time for which a button is held, in milliseconds, from the arrival of the nonce. */
const HOLD_MS = 1000;

/** The functions of the connection that buttons use.
 * @typedef {{ send: (message: object) => boolean, report: (text: string, mood: string) => void }} Link */

/** The present press; there is at most one.
 * @type {{ button: HTMLButtonElement, number: number, nonce: string | null, timer: number } | null} */
let press = null;
/** Number of presses: the nonce of an earlier one is ignored once the next was requested. */
let presses = 0;
/** The command that was sent last and has no answer yet. @type {string | null} */
let unanswered = null;
/** A text for the last command if its answer was lost. @type {string | null} */
let uncertain = null;

/** @param {HTMLButtonElement} button */
function named(button) {
  const { command = '', argument = null } = button.dataset;
  return { command, argument };
}

/** @param {Link} link @param {HTMLButtonElement} button */
function begin(link, button) {
  if (press || button.disabled) return;
  presses += 1;
  uncertain = null;
  press = { button, number: presses, nonce: null, timer: 0 };
  link.report('Keep holding ...', 'busy');
  if (!link.send({ kind: 'nonce', ...named(button), press: presses })) {
    cancel(link, 'No connection.');
  }
}

/** @param {Link} link @param {string} why */
function cancel(link, why) {
  if (!press) return;
  clearTimeout(press.timer);
  press.button.classList.remove('holding');
  press = null;
  link.report(why, 'warn');
}

/** A nonce has arrived: the second begins.
 * @param {Link} link @param {{ press: number | null, nonce: string }} message */
export function nonceReceived(link, message) {
  if (!press || press.nonce || press.number !== message.press) return;
  press.nonce = message.nonce;
  press.button.classList.add('holding');
  press.timer = setTimeout(() => {
    if (!press) return;
    const { button, nonce } = press;
    button.classList.remove('holding');
    press = null;
    const it = named(button);
    const sent = link.send({ kind: 'command', ...it, nonce });
    if (sent) unanswered = it.argument === null ? it.command : `${it.command} ${it.argument}`;
    link.report(sent ? 'Sent, waiting for the answer ...' : 'No connection.', sent ? 'busy' : 'bad');
  }, HOLD_MS);
}

/** An answer has arrived. @param {string} command its command, with the argument */
export function answered(command) {
  if (unanswered === command) unanswered = null;
}

/** Releases a held button, as nothing can be sent. @param {Link} link */
export function release(link) {
  cancel(link, 'The connection was lost: nothing was sent.');
}

/** No answer can arrive any more. @param {Link} link */
export function connectionLost(link) {
  release(link);
  if (unanswered === null) return;
  uncertain = `${unanswered}: the connection was lost before the answer: it may have been carried out`;
  unanswered = null;
  link.report(`${uncertain}; see "What happened".`, 'bad');
}

/** The text for a last command without an answer; `null` if it was answered or another was begun. */
export const uncertainty = () => uncertain;

/** Whether this button is held. @param {HTMLButtonElement} button */
export function isHeld(button) {
  return press !== null && press.button === button;
}

/** Makes a button one to hold. @param {Link} link @param {HTMLButtonElement} button */
export function holdable(link, button) {
  const releaseEarly = () => { if (isHeld(button)) cancel(link, 'Released too early: nothing was sent.'); };
  button.addEventListener('pointerdown', (event) => {
    if (event.button !== 0) return;
    button.setPointerCapture(event.pointerId);
    begin(link, button);
  });
  for (const end of ['pointerup', 'pointercancel', 'lostpointercapture', 'blur']) {
    button.addEventListener(end, releaseEarly);
  }
  button.addEventListener('contextmenu', (event) => event.preventDefault());
  button.addEventListener('keydown', (event) => {
    if (event.key !== ' ') return;
    event.preventDefault();
    if (!event.repeat) begin(link, button);
  });
  button.addEventListener('keyup', (event) => {
    if (event.key !== ' ') return;
    event.preventDefault();
    releaseEarly();
  });
}
