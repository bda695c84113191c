// @ts-check
// The page: receives the server's messages, shows them, and greys outdated values.
import { answered, connectionLost, uncertainty, holdable, isHeld, nonceReceived, release } from './hold.js';
import { Map2 } from './map.js';
import { follow } from './picture.js';
import { Strip } from './strips.js';

/** A value older than this is no longer current, in milliseconds. */
const STALE_MS = 700;
/** Data that are sent once a second are stale after this, in milliseconds. */
const SLOW_STALE_MS = 2600;
const RECONNECT_MS = 400;
const MAX_RECONNECT_MS = 1500;
/** Without a message for this time the connection is closed, in milliseconds. */
const SILENCE_MS = 3000;

/** @param {string} id */
const element = (id) => {
  const found = document.getElementById(id);
  if (!found) throw new Error(`there is no element ${id}`);
  return found;
};

/** Sets a text where it changes. @param {string | HTMLElement} where @param {string} text */
const put = (where, text) => {
  const node = typeof where === 'string' ? element(where) : where;
  if (node.textContent !== text) node.textContent = text;
};

/** Formats a number; zero has no sign. @param {number} value @param {number} digits */
const fixed = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]+$)/, '');

/** @param {number | null | undefined} value @param {number} digits @param {string} unit */
const number = (value, digits, unit) => (value == null ? '-' : `${fixed(value, digits)} ${unit}`);

/** @param {number} ms */
const age = (ms) => (ms < 9950 ? `${(ms / 1000).toFixed(1)} s` : `${Math.round(ms / 1000)} s`);

const degrees = (/** @type {number} */ radians) => (radians * 180) / Math.PI;

/** The last messages and the times of their arrival; `stampMs` is the newest stamp of the server.
 * @type {{ now: any, nowAt: number, slow: any, slowAt: number, receivedAt: number, stampMs: number | null, hello: any, offset: number | null, bestTrip: number, trip: number | null }} */
const known = { now: null, nowAt: 0, slow: null, slowAt: 0, receivedAt: 0, stampMs: null, hello: null, offset: null, bestTrip: Infinity, trip: null };
/** The picture that was drawn last. @type {{ header: any, at: number, drawn: number } | null} */
let picture = null;
let hasVideo = false;
/** @type {WebSocket | null} */
let socket = null;
let pause = RECONNECT_MS;
/** The reason for which the server refuses a connection of this page, with the remedy. */
let refusal = '';
const map = new Map2();
/** Receives and draws the pictures. @type {import('./picture.js').Follower | null} */
let video = null;
/** Whether refused candidates are shown. */
let showsRefused = false;

/** Age of a message, at least: since its arrival, or since the server's stamp, so that a slow link counts as well.
 * @param {number} at @param {number} arrivedAt @param {number | null} stampMs */
const since = (at, arrivedAt, stampMs) => Math.max(at - arrivedAt, known.offset === null || stampMs === null ? 0 : at + known.offset - stampMs);

const link = {
  /** @param {object} message */
  send(message) {
    if (!socket || socket.readyState !== WebSocket.OPEN) return false;
    socket.send(JSON.stringify(message));
    return true;
  },
  /** @param {string} text @param {string} mood */
  report(text, mood) {
    put('reply', text);
    element('reply').className = mood;
  },
};

const strips = {
  height: new Strip(element('strips'), 'Height', 'm', 2, 1, STALE_MS),
  lateral: new Strip(element('strips'), 'Distance from pad', 'm', 3, 0.1, STALE_MS),
  age: new Strip(element('strips'), 'Age of detection', 'ms', 0, 100, STALE_MS),
  picture: new Strip(element('strips'), 'Picture, light to screen', 'ms', 0, 100, STALE_MS),
  trip: new Strip(element('strips'), 'Page to server and back', 'ms', 1, 10, SLOW_STALE_MS),
};

/** @param {string} path */
const address = (path) => `${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}${path}`;

async function begin() {
  try {
    const answer = await fetch('/session');
    refusal = '';
    if (answer.ok) {
      element('login').hidden = true;
      connect();
      startVideo();
      return;
    }
    const why = await answer.json();
    element('login').hidden = answer.status !== 401;
    refusal = why.why;
    if (answer.status === 401) return;
  } catch {
    refusal = '';
  }
  setTimeout(begin, pause);
  pause = Math.min(2 * pause, MAX_RECONNECT_MS);
}

function connect() {
  const mine = new WebSocket(address('/ws'));
  socket = mine;
  [known.receivedAt, known.stampMs] = [performance.now(), null];
  // A new connection, perhaps to another server: its clock is compared again.
  known.bestTrip = Infinity;
  mine.onopen = () => {
    pause = RECONNECT_MS;
    ping();
  };
  mine.onmessage = (event) => take(JSON.parse(event.data));
  mine.onclose = () => { if (socket === mine) disconnect(); };
}

/** Closes the connection, and tries another one. */
function disconnect() {
  // A connection that hangs would take long to close.
  const old = socket;
  socket = null;
  old?.close();
  connectionLost(link);
  setTimeout(begin, pause);
  pause = Math.min(2 * pause, MAX_RECONNECT_MS);
}

/** @param {any} message */
function take(message) {
  const at = performance.now();
  known.receivedAt = at;
  if (message.now_ms != null) known.stampMs = Math.max(known.stampMs ?? message.now_ms, message.now_ms);
  if (message.kind === 'now') {
    [known.now, known.nowAt] = [message, at];
    showNow(message, at);
  } else if (message.kind === 'slow') {
    [known.slow, known.slowAt] = [message, at];
    map.funnel = message.funnel;
    showSlow(message);
  } else if (message.kind === 'log') {
    showLog(message);
  } else if (message.kind === 'hello') {
    if (known.hello && known.hello.vehicle !== message.vehicle) {
      restart();
      return;
    }
    known.hello = message;
    showHello(message);
  } else if (message.kind === 'pong') {
    const trip = at - message.at_ms;
    known.trip = trip;
    strips.trip.add(at, trip);
    // The fastest answer gives the best difference of the clocks; others may have waited.
    known.bestTrip *= 1.02;
    if (trip <= known.bestTrip) [known.bestTrip, known.offset] = [trip, message.now_ms - (message.at_ms + trip / 2)];
  } else if (message.kind === 'nonce') {
    nonceReceived(link, message);
  } else if (message.kind === 'reply') {
    answered(message.command);
    const verdict = `${message.accepted ? 'accepted' : 'refused'} by the ${message.who}`;
    link.report(`${message.command}: ${message.who === 'nobody' ? 'no answer' : verdict}: ${message.why}`, message.accepted ? 'good' : 'bad');
  }
}

/** Reloads the page, as the server now is that of another vehicle: no data of the previous vehicle are shown with it, and no held
 * button commands it. Only a command without an answer is still reported, with the name of its vehicle. */
function restart() {
  const old = socket;
  socket = null;
  old?.close();
  connectionLost(link);
  const uncertain = uncertainty();
  if (uncertain !== null) sessionStorage.setItem('uncertain', `${known.hello.vehicle}: ${uncertain}.`);
  location.reload();
}

/** @param {any} hello */
function showHello(hello) {
  document.title = `${hello.vehicle} - Alight`;
  put('vehicle-name', hello.vehicle);
  put('host', `${hello.host}, version ${hello.version}`);
  put('commands-note', hello.no_commands ? `No commands: ${hello.no_commands}.` : 'Hold a button, or the space bar on it, for one second.');
  // A page that may be viewed without a token may need one for commands.
  element('login').hidden = !hello.needs_token;
  enable();
}

/** Enables or disables the buttons. One that is disabled is not held any more, as it gets no event when it is released. */
function enable() {
  const may = known.hello && !known.hello.no_commands && isConnected();
  if (!may) release(link);
  for (const button of document.querySelectorAll('button.hold')) {
    /** @type {HTMLButtonElement} */ (button).disabled = !may;
  }
}

const isConnected = () => socket !== null && socket.readyState === WebSocket.OPEN && since(performance.now(), known.receivedAt, known.stampMs) < STALE_MS;

/** Asks for the server's time. */
const ping = () => link.send({ kind: 'ping', at_ms: performance.now() });

/** @param {any} message @param {number} at */
function showNow({ status, target, vehicle, now_ms: stampMs }, at) {
  if (status) {
    const isCurrent = status.age_ms + since(at, at, stampMs) < STALE_MS;
    put('title', status.title);
    element('title').className = `title ${status.mood}`;
    // Replies and logs have this name of the phase.
    put('phase-name', status.phase);
    put('why', status.why);
    put('next', status.next);
    put('height', number(status.height_m, 2, 'm'));
    put('lateral', number(status.lateral_error_m, 3, 'm'));
    put('detection-age', number(status.detection_age_ms, 0, 'ms'));
    put('latency', status.latency_ms ? `${status.latency_ms[0].toFixed(0)} to ${status.latency_ms[1].toFixed(0)} ms` : '-');
    const [vn, ve, vd] = status.setpoint_m_s ?? [];
    put('setpoint', status.setpoint_m_s ? `${Math.hypot(vn, ve).toFixed(2)} ${vd <= -0.005 ? '↑' : '↓'} ${Math.abs(vd).toFixed(2)} m/s` : '-');
    put('since', number(status.since_start_s, 1, 's'));
    put('autopilot', `${status.autopilot}${status.setpoint_timeout_s == null ? '' : `; stops ${status.setpoint_timeout_s} s after the last setpoint`}`);
    put('detector-why', `${status.detector ? `In use: ${status.detector}` : 'None is in use'} (${status.detector_why}); preferred: ${status.preference || 'none'}; ${status.detector_changes} changes.`);
    rows(element('warnings'), status.warnings.map((/** @type {string} */ text) => ['li', text]));
    strips.height.add(at, isCurrent ? status.height_m : null);
    strips.lateral.add(at, isCurrent ? status.lateral_error_m : null);
    strips.age.add(at, isCurrent ? status.detection_age_ms : null);
  }
  if (vehicle) {
    put('mode', vehicle.mode);
    put('armed', vehicle.armed ? 'armed' : 'off');
    element('armed').className = vehicle.armed ? 'warn' : '';
    put('landed', vehicle.landed);
    put('battery', vehicle.battery == null ? 'unknown' : `${Math.round(vehicle.battery * 100)} %`);
    const [vn, ve, vd] = vehicle.velocity_m_s;
    put('down', number(vd, 2, 'm/s'));
    put('sideways', number(Math.hypot(vn, ve), 2, 'm/s'));
    put('tilt', `${degrees(Math.acos(Math.min(1, Math.cos(vehicle.roll_rad) * Math.cos(vehicle.pitch_rad)))).toFixed(1)}°`);
    put('heading', `${Math.round((degrees(vehicle.heading_rad) + 360) % 360)}°`);
  }
  if (target) {
    const refused = target.rejected ? `latest detection refused: ${target.decided ?? target.rejected}` : target.decided ?? '';
    put('target-text', `${target.deviation_m == null ? '' : `Known to ${(3 * target.deviation_m).toFixed(3)} m (dashed, three deviations). `}${refused}`);
  }
  map.take(vehicle, target && target.position_m ? target : null);
}

/** Sets the children of a list or table; existing elements are reused.
 * @param {HTMLElement} parent @param {[string, string, string?][]} entries */
function rows(parent, entries) {
  while (parent.children.length > entries.length) parent.lastElementChild?.remove();
  entries.forEach(([tag, text, mood = ''], n) => {
    let child = /** @type {HTMLElement | undefined} */ (parent.children[n]);
    if (!child) {
      child = document.createElement(tag);
      parent.append(child);
    }
    put(child, text);
    if (child.className !== mood) child.className = mood;
  });
}

/** A row of a table by its key, made where it is missing.
 * @param {HTMLElement} body @param {string} key @param {number} cells */
function row(body, key, cells) {
  let found = /** @type {HTMLTableRowElement | undefined} */ ([...body.children].find((it) => /** @type {HTMLElement} */ (it).dataset.key === key));
  if (!found) {
    found = document.createElement('tr');
    found.dataset.key = key;
    found.setAttribute('role', 'row');
    // Where a row is a card, each cell shows the name of its column.
    const columns = [...(body.closest('table')?.querySelectorAll('th') ?? [])];
    for (let n = 0; n < cells; n += 1) {
      const cell = document.createElement('td');
      cell.setAttribute('role', 'cell');
      cell.dataset.column = columns[n]?.textContent ?? '';
      found.append(cell);
    }
    body.append(found);
  }
  return found;
}

/** @param {HTMLElement} body @param {string[]} keys */
function forget(body, keys) {
  for (const child of [...body.children]) {
    if (!keys.includes(/** @type {HTMLElement} */ (child).dataset.key ?? '')) child.remove();
  }
}

/** @param {any} slow */
function showSlow({ detectors, services, recorders, bridges, checks }) {
  const table = /** @type {HTMLElement} */ (element('detectors').querySelector('tbody'));
  for (const it of detectors) {
    const line = row(table, it.name, 9);
    const texts = [
      it.name, it.state, [it.place, it.host].filter(Boolean).join(', ') || '-', number(it.rate_hz, 1, 'Hz'), number(it.latency_ms, 0, 'ms'),
      it.age_ms == null ? '-' : age(it.age_ms),
      it.compared ? `${it.agreed} of ${it.compared}${it.disagreement_m == null ? '' : `, ${it.disagreement_m.toFixed(3)} m`}` : '-',
      it.sees ?? (it.seen === 0 ? 'no marker' : '-'),
    ];
    texts.forEach((text, n) => put(/** @type {HTMLElement} */ (line.children[n]), text));
    // A detector that is in use only because there is no better one is not in a good state.
    line.children[1].className = it.state === 'in use' ? 'good' : it.state === 'standby' ? '' : it.state.startsWith('not known') ? 'calm' : 'bad';
    line.dataset.age = it.age_ms == null ? '' : String(it.age_ms);
    if (!line.querySelector('button')) {
      const button = document.createElement('button');
      button.type = 'button';
      button.className = 'hold';
      button.textContent = 'Use';
      button.setAttribute('aria-label', `Use the detector ${it.name}`);
      button.dataset.command = 'use-detector';
      button.dataset.argument = it.name;
      holdable(link, button);
      line.children[8].append(button);
      enable();
    }
  }
  // The row of a held button is not removed.
  const held = [...table.querySelectorAll('button')].find((button) => isHeld(button));
  forget(table, [...detectors.map((/** @type {any} */ it) => it.name), held?.dataset.argument ?? '']);

  const processes = /** @type {HTMLElement} */ (element('services').querySelector('tbody'));
  const keys = services.map((/** @type {any} */ it) => `${it.service} ${it.instance}`);
  for (const it of services) {
    const line = row(processes, `${it.service} ${it.instance}`, 7);
    const rates = Object.entries(it.rates).map(([name, hz]) => `${name} ${Number(hz).toFixed(1)} Hz`);
    const faults = [...Object.entries(it.drops), ...Object.entries(it.errors)].map(([name, count]) => `${name}: ${count}`);
    const texts = [
      `${it.service} ${it.instance}`, it.host, `${it.silent ? 'silent, ' : ''}${age(it.age_ms)} ago`,
      it.round_trip_ms == null ? 'no answer' : `${it.round_trip_ms.toFixed(1)} ms`,
      it.cpu_percent == null ? '-' : `${it.cpu_percent.toFixed(0)} %`, rates.join(', ') || '-', faults.join('; ') || 'none',
    ];
    texts.forEach((text, n) => put(/** @type {HTMLElement} */ (line.children[n]), text));
    line.children[2].className = it.silent ? 'bad' : '';
    line.children[6].className = Object.keys(it.errors).length > 0 ? 'warn' : '';
    line.dataset.age = String(it.age_ms);
  }
  forget(processes, keys);
  put('recorders', recorders.length === 0 ? 'No recorder.' : recorders.map((/** @type {any} */ it) => `Recorder ${it.name}: ${it.problem ?? `${it.file}, ${(it.bytes / 1e6).toFixed(1)} MB, ${it.kept} messages, ${it.lost} lost${it.free_bytes === null ? '' : `, ${(it.free_bytes / 1e9).toFixed(1)} GB free`}`} (${age(it.age_ms)} ago)`).join(' '));
  const ground = element('bridges');
  rows(ground, bridges.map((/** @type {any} */ it, /** @type {number} */ n) => {
    const further = it.unlisted > 0 ? `, and ${it.unlisted} packet${it.unlisted === 1 ? '' : 's'} of further stations` : '';
    const stations = it.problem ?? `${it.stations.join(', ') || 'none yet'}${further}`;
    // A grey line stays grey until its age is checked.
    return ['span', `Ground stations of ${it.name}: ${stations}; ${it.signing}; ${it.refused} refused (${age(it.age_ms)} ago). `, ground.children[n]?.className];
  }));
  bridges.forEach((/** @type {any} */ it, /** @type {number} */ n) => {
    /** @type {HTMLElement} */ (ground.children[n]).dataset.age = String(it.age_ms);
  });

  const list = element('checks');
  const signs = /** @type {any} */ ({ good: '✓', open: '·', bad: '✗' });
  checks.forEach((/** @type {any} */ it, /** @type {number} */ n) => {
    let line = /** @type {HTMLElement | undefined} */ (list.children[n]);
    if (!line) {
      line = document.createElement('li');
      for (const name of ['sign', 'name', 'text', 'todo']) {
        const part = document.createElement('span');
        part.className = name;
        line.append(part);
      }
      list.append(line);
    }
    const [sign, name, text, todo] = /** @type {HTMLElement[]} */ ([...line.children]);
    put(sign, signs[it.verdict]);
    sign.className = `sign ${it.verdict === 'open' ? 'calm' : it.verdict}`;
    sign.setAttribute('aria-label', it.verdict);
    put(name, it.name);
    put(text, it.text);
    put(todo, it.verdict === 'bad' ? it.todo : '');
  });
}

/** @param {any} log */
function showLog({ now_ms: now, entries }) {
  const list = element('log');
  const isAtEnd = list.scrollTop + list.clientHeight >= list.scrollHeight - 20;
  list.replaceChildren(...entries.map((/** @type {any} */ it) => {
    const line = document.createElement('li');
    const at = document.createElement('time');
    at.textContent = new Date(Date.now() - (now - it.at_ms)).toLocaleTimeString([], { hourCycle: 'h23' });
    at.className = 'quiet';
    const text = document.createElement('span');
    text.textContent = it.text;
    text.className = it.level === 'info' ? '' : it.level;
    line.append(at, text);
    return line;
  }));
  if (isAtEnd) list.scrollTop = list.scrollHeight;
}

/** Greys outdated values, and shows their age. */
function checkAges() {
  const at = performance.now();
  const connected = isConnected();
  // A connection with late messages does not count as connected either.
  const silent = at - known.receivedAt;
  const lost = silent < STALE_MS && socket?.readyState === WebSocket.OPEN ? `${age(since(at, known.receivedAt, known.stampMs))} behind` : `no connection for ${age(silent)}`;
  put('connection', connected ? 'connected' : (!socket && refusal) || lost);
  element('connection').className = `badge ${connected ? 'good' : 'lost'}`;
  document.querySelector('main')?.classList.toggle('cut-off', !connected);
  if (socket && silent > SILENCE_MS) disconnect();
  const nowOld = known.now ? since(at, known.nowAt, known.now.now_ms) : Infinity;
  const slowOld = known.slow ? since(at, known.slowAt, known.slow.now_ms) : Infinity;
  for (const panel of document.querySelectorAll('[data-group]')) {
    const names = (/** @type {HTMLElement} */ (panel).dataset.group ?? '').split(' ');
    const ages = names.map((name) => known.now?.[name]?.age_ms);
    // A panel with several messages is as old as the oldest one.
    const old = ages.includes(undefined) ? null : Math.max(...ages) + nowOld;
    const isStale = old === null || old > STALE_MS;
    panel.classList.toggle('stale', isStale);
    const label = panel.querySelector('.age');
    if (label) put(/** @type {HTMLElement} */ (label), old === null ? 'no data' : isStale ? `${age(old)} old` : '');
  }
  const status = known.now?.status;
  const phaseOld = status ? status.age_ms + nowOld : Infinity;
  // These are part of the status, and shown in other panels.
  for (const id of ['autopilot', 'detector-why']) element(id).classList.toggle('old', phaseOld > STALE_MS);
  const badge = element('phase');
  if (phaseOld <= STALE_MS) {
    put(badge, status.title);
    badge.className = `badge ${status.mood}`;
  } else {
    // Without current data of the server, which may have refused the page, it is not known whether there is a controller.
    put(badge, status ? `was: ${status.title}, ${age(phaseOld)} ago` : nowOld <= STALE_MS ? 'No controller' : 'No data');
    badge.className = 'badge lost';
  }
  for (const line of document.querySelectorAll('tbody tr, #bridges span')) {
    const stated = /** @type {HTMLElement} */ (line).dataset.age;
    const limit = line.closest('#detectors') ? SLOW_STALE_MS - 1000 : line.closest('#bridges') ? SLOW_STALE_MS + 4000 : SLOW_STALE_MS + 1000;
    line.classList.toggle('old', !stated || Number(stated) + slowOld > limit);
  }
  for (const id of ['checks', 'recorders', 'bridges']) element(id).classList.toggle('old', slowOld > SLOW_STALE_MS);
  if (picture) {
    const old = since(at, picture.at, picture.header.shown_ms);
    const isOld = old > STALE_MS;
    element('video-panel').classList.toggle('stale', isOld);
    put('video-age', isOld ? `${age(old)} old` : '');
    element('video-age').className = isOld ? 'lost' : 'quiet';
  }
  const trip = known.trip === null ? '-' : `${known.trip.toFixed(1)} ms`;
  put('page-link', `This page: ${trip} to the server and back; ${picture ? `${picture.drawn} pictures drawn` : 'no pictures'}.`);
  enable();
}

/** @param {any} message */
function pictureDrawn(message) {
  if (message.kind !== 'drawn') return;
  const at = performance.now();
  const { header } = message;
  picture = { header, at, drawn: message.drawn };
  const light = known.offset === null ? null : at + known.offset - header.taken_ms;
  // Stamps of another host's clock do not show here when the frame was exposed.
  strips.picture.add(at, header.is_own_clock ? light : null);
  const seen = header.markers === null ? 'no detections arrived in time' : `${header.detector}${header.is_used ? '' : ' (not in use)'} found ${header.markers.length} in it`;
  showRefused(header);
  put('video-text', `${header.camera} ${header.sequence}, ${header.width} x ${header.height}: ${seen}${light === null ? '' : `; ${light.toFixed(0)} ms after ${header.is_own_clock ? 'the light' : 'it came'}`}.`);
}

/** Shows the candidates that the detector refused in the present picture, by reason.
 * @param {any} header */
function showRefused({ detector, refused, refused_total: total }) {
  const text = () => {
    if (!showsRefused) return '';
    if (!refused) return 'The refused candidates did not arrive in time.';
    if (total === 0) return `${detector} refused nothing in it.`;
    const counts = new Map();
    for (const { reason } of refused) counts.set(reason, (counts.get(reason) ?? 0) + 1);
    const reasons = [...counts].sort((a, b) => b[1] - a[1]).map(([reason, count]) => `${count} ${reason}`).join(', ');
    return `${detector} refused ${total} candidate${total === 1 ? '' : 's'} in it${refused.length < total ? `, of which the ${refused.length} largest are drawn` : ''}: ${reasons}.`;
  };
  put('refused-text', text());
}

element('refused').addEventListener('click', () => {
  showsRefused = !showsRefused;
  element('refused').setAttribute('aria-pressed', String(showsRefused));
  video?.showRefused(showsRefused);
  if (!showsRefused) put('refused-text', '');
});

function startVideo() {
  // A canvas is transferred once. Its connection is opened again when it ends; one that hangs gives no event.
  if (hasVideo) {
    video?.reconnect();
    return;
  }
  hasVideo = true;
  const canvas = /** @type {HTMLCanvasElement} */ (element('video'));
  const url = address('/video');
  if (!('createImageBitmap' in window)) {
    const image = document.createElement('img');
    [image.id, image.alt, image.src] = ['video', "The camera's picture", '/video.mjpeg'];
    canvas.replaceWith(image);
    put('video-text', 'This browser cannot draw detections into the picture, and does not show the age of a picture.');
    element('refused').hidden = true;
    video = { reconnect: () => { image.src = `/video.mjpeg?${performance.now()}`; }, showRefused: () => {} };
  } else if ('transferControlToOffscreen' in canvas && 'Worker' in window) {
    const offscreen = canvas.transferControlToOffscreen();
    const worker = new Worker('/worker.js', { type: 'module' });
    worker.onmessage = (event) => pictureDrawn(event.data);
    worker.postMessage({ canvas: offscreen, address: url }, [offscreen]);
    video = {
      reconnect: () => worker.postMessage({ reconnect: true }),
      showRefused: (on) => worker.postMessage({ showRefused: on }),
    };
  } else {
    video = follow(canvas, url, pictureDrawn);
  }
}

function redraw() {
  const now = performance.now();
  for (const strip of Object.values(strips)) strip.draw(now);
  map.drawAbove(/** @type {HTMLCanvasElement} */ (element('map')));
  map.drawSide(/** @type {HTMLCanvasElement} */ (element('side')));
}

element('login').addEventListener('submit', async (event) => {
  event.preventDefault();
  const token = /** @type {HTMLInputElement} */ (element('token'));
  const answer = await fetch('/login', { method: 'POST', body: token.value });
  token.value = '';
  if (answer.ok) {
    put('login-problem', '');
    // A connection retains the rights with which it was opened.
    const old = socket;
    socket = null;
    old?.close();
    begin();
  } else {
    put('login-problem', 'This token is not valid.');
  }
});

/** @param {string} theme */
function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  element('theme').setAttribute('aria-pressed', String(theme === 'sun'));
}
element('theme').addEventListener('click', () => {
  const theme = document.documentElement.dataset.theme === 'sun' ? 'dark' : 'sun';
  localStorage.setItem('theme', theme);
  setTheme(theme);
});
setTheme(localStorage.getItem('theme') === 'sun' ? 'sun' : 'dark');

/** On a small screen the commands are below its lower edge: the abort and the replies are then in the header, which is always visible.
 * The name of the host makes room for them. */
const small = matchMedia('(max-width: 56rem)');
function placeAbort() {
  const abort = /** @type {HTMLElement} */ (document.querySelector('button[data-command=abort]'));
  // A press ends before the button moves: its release would not be noticed.
  abort.dispatchEvent(new Event('pointercancel'));
  if (small.matches) {
    element('at-hand').append(abort, element('reply'));
    element('page-link').after(element('host'));
  } else {
    element('danger').prepend(abort);
    element('danger').after(element('reply'));
    element('theme').before(element('host'));
  }
}
small.addEventListener('change', placeAbort);
placeAbort();

for (const button of document.querySelectorAll('button.hold')) holdable(link, /** @type {HTMLButtonElement} */ (button));
const uncertainBefore = sessionStorage.getItem('uncertain');
if (uncertainBefore !== null) link.report(uncertainBefore, 'bad');
sessionStorage.removeItem('uncertain');
enable();
begin();
setInterval(checkAges, 100);
setInterval(redraw, 200);
setInterval(ping, 1000);
