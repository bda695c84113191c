// @ts-check
// Buttons that command only when they are held for a second, by pointer or space bar.
//
// The nonce is asked for when the button goes down, so the server knows by itself how long it was held.

/** Time that a button is held, in milliseconds, from the nonce on. */
const HOLD_MS = 1000;

/** What buttons need from the connection.
 * @typedef {{ send: (message: object) => boolean, tell: (text: string, mood: string) => void }} Link */

/** The press under way; there is one at most.
 * @type {{ button: HTMLButtonElement, number: number, nonce: string | null, timer: number } | null} */
let press = null;
/** Presses so far: the nonce of an earlier one is good for nothing once the next was asked for. */
let presses = 0;
/** The command that was sent last and has no answer yet. @type {string | null} */
let unanswered = null;
/** What is not known of the last command, as its answer was lost. @type {string | null} */
let doubt = null;

/** @param {HTMLButtonElement} button */
function named(button) {
  const { command = '', argument = null } = button.dataset;
  return { command, argument };
}

/** @param {Link} link @param {HTMLButtonElement} button */
function begin(link, button) {
  if (press || button.disabled) return;
  presses += 1;
  doubt = null;
  press = { button, number: presses, nonce: null, timer: 0 };
  link.tell('Keep holding ...', 'busy');
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
  link.tell(why, 'warn');
}

/** A nonce has come: the second begins.
 * @param {Link} link @param {{ press: number | null, nonce: string }} message */
export function nonceCame(link, message) {
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
    link.tell(sent ? 'Sent, waiting for the answer ...' : 'No connection.', sent ? 'busy' : 'bad');
  }, HOLD_MS);
}

/** An answer has come. @param {string} command what it is for, with its argument */
export function answered(command) {
  if (unanswered === command) unanswered = null;
}

/** Lets go of whatever is held, as nothing can be sent. @param {Link} link */
export function release(link) {
  cancel(link, 'The connection was lost: nothing was sent.');
}

/** No answer comes any more. @param {Link} link */
export function connectionLost(link) {
  release(link);
  if (unanswered === null) return;
  doubt = `${unanswered}: the connection was lost before the answer: it may have been carried out`;
  unanswered = null;
  link.tell(`${doubt}; see "What happened".`, 'bad');
}

/** What is not known of the last command; `null` where it was answered or another was begun. */
export const doubted = () => doubt;

/** Whether this button is held. @param {HTMLButtonElement} button */
export function isHeld(button) {
  return press !== null && press.button === button;
}

/** Makes a button one to hold. @param {Link} link @param {HTMLButtonElement} button */
export function holdable(link, button) {
  const letGo = () => { if (isHeld(button)) cancel(link, 'Let go too early: nothing was sent.'); };
  button.addEventListener('pointerdown', (event) => {
    if (event.button !== 0) return;
    button.setPointerCapture(event.pointerId);
    begin(link, button);
  });
  for (const end of ['pointerup', 'pointercancel', 'lostpointercapture', 'blur']) {
    button.addEventListener(end, letGo);
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
    letGo();
  });
}
