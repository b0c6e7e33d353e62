// Connects the parts of the page: scene and loudness over HTTP, poses and audio through the stream worker, the floor plan, the panels
// and the keyboard.

import { Comparison } from "./comparison.js";
import { askForKey, key } from "./access.js";
import { FloorPlan } from "./floorplan.js";
import { inNextFrame } from "./frames.js";
import { Effects } from "./effects.js";
import { Frontier, HERE } from "./frontier.js";
import { LocalWorkerStream } from "./nafir/field/local_worker_stream.js";
import { PoseLedger, TurnLedger } from "./nafir/latency.js";
import { WorkerStream } from "./nafir/worker_stream.js";
import { Heads } from "./heads.js";
import { Legend } from "./legend.js";
import { LoudnessField, combine, parseGrid, raised, scaleOf } from "./loudness.js";
import { Notices } from "./notices.js";
import { exposeHook } from "./hook.js";
import { OwnSounds, isOwn } from "./own_sounds.js";
import { onThemeChange } from "./palette.js";
import { Panel } from "./panel.js";
import { Paper } from "./paper.js";
import { PhoneTurning } from "./phone.js";
import { Player, rateFor } from "./player.js";
import { fetchClips, fetchDecoder, fetchFrontier, fetchHeads, fetchLoudness, fetchScene, fetchScenes, fetchSection, streamUrl } from "./scenes.js";
import { linkTo, readSituation } from "./situation.js";
import { Sources } from "./sources.js";
import { Storeys } from "./storeys.js";
import { Turning } from "./turning.js";
import { Walking } from "./walking.js";
import { World } from "./world.js";

const DRY = { early_reflections: false, late_reverberation: false };
const AS_PLANNED = { early_reflections: null, late_reverberation: null };
const ORDER = 1; // of ambisonic streams
const NO_FIELD = "none";
const LIKELY_HZ = 48_000; // of a sound card, until it is known
const SETTLED_MS = 300; // a choice is made for so long before another stream begins: keys pass through levels on their way
const SLOW_MS = 1000; // after which the page says that a level is being prepared
const GOES_ON = "What you hear goes on until it is there.";
const REST_MS = 1000; // the turn of a head at rest is measured this often
const RETRY_MS = 2000;
const SHUTTING_DOWN = 1012; // a close code
const AWAY = ["unreachable", "server_draining", "not_ready"]; // codes of a server that will be there again
const LONGEST_RETRY_MS = 30_000;
const CUT_M = 1.3; // above a floor: doors and windows show, and most furniture does not
const DOOR_RESTS_MS = 250; // a door that moves has no map
const WORLDLY = ["listener", "emitter", "remove", "door"]; // what a stream is told that is not heard yet

const find = (id) => document.getElementById(id);
const epochNow = () => performance.timeOrigin + performance.now();
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
const placeKey = ({ position }) => position.map((value) => value.toFixed(3)).join();

class Page {
  constructor() {
    this.notices = new Notices(find("notices"));
    this.panel = new Panel(document);
    this.legend = new Legend(find("legend"));
    this.frontier = new Frontier(find("quality"));
    this.comparison = new Comparison(find("compare"));
    this.isDry = false; // whether a comparison has switched all but the direct sound off
    this.effects = new Effects(find("rendered"));
    this.heads = new Heads(find("head"));
    this.turning = new Turning(find("turning"));
    this.phone = new PhoneTurning(find("phone"));
    this.output = null; // of the present stream; null while there is none
    this.rendered = null; // the server's plan of effects; null while there is no stream
    this.level = this.head = null; // the present level and head; null while there is no stream
    this.decoded = this.decodedHz = null; // the head whose filters the worklet has, and their rate
    this.rate = undefined; // the sample rate that the link of the page asks for
    this.player = new Player();
    this.own = new OwnSounds();
    this.ledger = new PoseLedger();
    this.reverberationLedger = new PoseLedger();
    this.turnLedger = new TurnLedger();
    this.turnedAt = 0;
    this.remote = new WorkerStream(); // a server's stream
    this.local = null; // one that is rendered here, once it is wanted
    this.stream = this.remote; // the one that is heard
    this.used = "auto"; // the level that was chosen for it
    this.coming = null; // {stream, output, port, slow}: one that is being prepared, to be heard in its place; `slow` is a timer
    this.connection = "idle";
    this.playing = false;
    this.isFed = false; // whether the visitor's own sounds go into the stream
    this.steady = false;
    this.grids = new Map(); // emitter id -> {key, grid}
    this.mapping = null; // AbortController of the request for the next map
    this.field = null;
    this.scale = null;
    this.scaled = 0; // number of emitters that the scale was made for
    this.hovered = null;
    this.storey = undefined; // the one that is drawn; null where there are none
  }

  async open() {
    this.#setConnection("connecting", "Loading");
    const { scenes, max_emitters: mostEmitters } = await this.#untilAnswered(fetchScenes);
    const wanted = new URLSearchParams(location.search).get("scene");
    const chosen = scenes.find(({ id }) => id === wanted) ?? scenes[0];
    if (!chosen) {
      this.notices.show("scene", "The server has no scene to play.", { lasting: true });
      return;
    }
    if (wanted && chosen.id !== wanted) this.notices.show("scene", `There is no scene called “${wanted}”; this is ${chosen.name}.`);
    this.#offer(scenes, chosen); // first, so that another scene can be chosen even if this one fails
    const scene = await this.#untilAnswered(() => fetchScene(chosen.id));
    this.#describe(scene);
    const clips = (await fetchClips().catch(() => null)) ?? [];
    this.#setUp(scene, { clips, mostEmitters });
    this.#fill("heads", fetchHeads, (heads) => {
      this.heads.show(heads);
      if (this.turning.isHere) this.#listenWithHead(); // a server may take a second to make the filters
    });
    if (clips.length === 0) this.#fill("clips", fetchClips, (found) => this.#gotClips(found));
    this.#fill("frontier", () => fetchFrontier(scene.id), (frontier) => this.#showLevels(frontier));
    this.#setConnection("idle", "Ready");
  }

  /** Fills a part of the page that the rest does not need, and tries again later if that fails. */
  async #fill(part, ask, show) {
    for (let wait = RETRY_MS; ; wait = Math.min(2 * wait, LONGEST_RETRY_MS)) {
      try {
        show(await ask());
        return;
      } catch (error) {
        if (part === "frontier") this.frontier.fail(error.message);
        await pause(wait);
      }
    }
  }

  #gotClips(clips) {
    if (clips.length === 0) throw new Error("no clip yet");
    this.notices.clear("clips");
    this.clips = clips;
    this.sources.clips = clips;
    if (this.world.emitters.size === 0) this.world.addEmitter({ clip: clips[0].name, position: this.scene.emitter.position });
  }

  async #untilAnswered(ask) {
    for (;;) {
      try {
        const answer = await ask();
        this.notices.clear("unreachable");
        return answer;
      } catch (error) {
        this.#setConnection("waiting", "Waiting for the server");
        this.notices.show("unreachable", `${error.message} Trying again.`, { lasting: true });
        await pause(RETRY_MS);
      }
    }
  }

  #offer(scenes, chosen) {
    find("scene-name").textContent = chosen.name;
    if (scenes.length < 2) return;
    const choice = find("scene-choice");
    choice.replaceChildren(...scenes.map(({ id, name }) => new Option(name, id, false, id === chosen.id)));
    choice.hidden = false;
    find("scene-name").hidden = true;
    choice.onchange = () => {
      const link = new URL(location.href);
      link.searchParams.set("scene", choice.value);
      link.hash = "";
      location.assign(link);
    };
  }

  #describe(scene) {
    const xs = scene.corners.map(([x]) => x);
    const ys = scene.corners.map(([, y]) => y);
    const size = [xs, ys].map((values) => +(Math.max(...values) - Math.min(...values)).toFixed(1));
    find("scene-size").textContent = `${size[0]} × ${size[1]} × ${+scene.height_m.toFixed(2)} m`;
    document.documentElement.style.setProperty("--aspect", (size[0] / size[1]).toFixed(3));
    document.title = `${scene.name} · Nafir`;
  }

  #setUp(scene, { clips, mostEmitters }) {
    this.scene = scene;
    this.#chooseRate(new URLSearchParams(location.search).get("rate"));
    this.clips = clips;
    this.world = new World(scene, { mostEmitters });
    this.turning.directionalLevels = scene.directional_levels ?? [];
    this.frontier.offersHere = (scene.directional_levels ?? []).length > 0 && !scene.is_mesh;
    // Where nothing reverberates, all that is heard is the direct sound. It is sharper through the filters of the head itself.
    if (scene.levels.every(({ field }) => field === NO_FIELD)) this.turning.usual = "server";
    this.panel.turnsHere = this.turning.isHere;
    this.#turnHead();
    this.#restore(readSituation(location.hash));
    if (clips.length === 0) this.notices.show("clips", "The server has no clip to play.", { lasting: true });
    this.paper = new Paper(find("paper"), scene);
    this.plan = new FloorPlan({ svg: find("marks"), paper: this.paper, world: this.world });
    find("door-hint").hidden = this.world.doors.size === 0;
    new Storeys(find("storey-choice"), this.world, (storey) => this.#showStorey(storey));
    this.sources = new Sources({ world: this.world, clips, list: find("sources"), add: find("add-source"), limit: find("source-limit") });
    new Walking(this.world, { focusedEmitter: () => this.plan.focusedEmitter, dropped: () => this.map() });
    this.#listenToWorld();
    this.#listenToSound();
    this.#listenToControls();
    this.#listenToOwnSounds();
    this.map();
    find("play").disabled = false;
    document.body.classList.add("ready");
  }

  /** Takes the rate that the link of the page asks for; without one it is that of the sound card. */
  #chooseRate(wanted) {
    if (wanted === null) return;
    const offered = this.scene.sample_rates ?? [this.scene.sample_rate];
    if (offered.includes(Number(wanted))) this.rate = Number(wanted);
    else this.notices.show("rate", `The scene is not played at a rate of “${wanted}”, but at ${offered.join(", ")} Hz.`);
  }

  #listenToWorld() {
    const { world, plan } = this;
    let known = new Map();
    world.addEventListener("listener", () => {
      this.#turnHead();
      this.#tell("listener", this.#listenerNow());
      inNextFrame(this.#pointNeedle);
    });
    world.addEventListener("emitter", ({ detail }) => {
      this.#say(detail);
      if (this.grids.get(detail.id)?.key !== this.#gridKey(detail)) this.paper.stale = true;
    });
    world.addEventListener("emitters", () => {
      for (const id of known.keys()) if (!world.emitters.has(id)) this.#remove(id);
      for (const [id, emitter] of world.emitters) if (!known.has(id)) this.#say(emitter);
      known = new Map(world.emitters);
      this.map();
    });
    known = new Map(world.emitters);
    world.addEventListener("gain", () => this.map());
    let rest = 0;
    world.addEventListener("door", ({ detail: { name, openness } }) => {
      this.#tell("door", { name, openness });
      this.paper.stale = true;
      clearTimeout(rest);
      rest = setTimeout(() => this.map(), DOOR_RESTS_MS);
    });
    plan.addEventListener("dropped", () => this.map());
    plan.addEventListener("hover", ({ detail }) => {
      this.hovered = detail;
      inNextFrame(this.#pointNeedle);
    });
  }

  #listenToSound() {
    this.player.addEventListener("report", ({ detail }) => {
      if (!this.playing || this.connection !== "live") return;
      this.steady = detail.playing;
      this.panel.report(detail, { direct: this.ledger, reverberation: this.reverberationLedger, turn: this.turnLedger });
      inNextFrame(this.#drawLevels);
      if (this.output === "ambisonics" && epochNow() - this.turnedAt >= REST_MS) this.#turnHead();
    });
    this.player.addEventListener("turned", ({ detail }) => {
      if (this.steady) this.turnLedger.turned(detail);
    });
    this.player.addEventListener("heard", ({ detail }) => {
      this.ledger.heard(detail, this.steady);
      this.reverberationLedger.heard({ ...detail, poseId: detail.reverberationPoseId }, this.steady);
    });
    this.player.addEventListener("interrupted", () => this.pause());
    this.#listenToStream(this.remote);
  }

  #listenToStream(stream) {
    const handlers = {
      state: (detail) => this.#streamState(detail),
      posed: (detail) => {
        this.ledger.posed(detail);
        this.reverberationLedger.posed(detail);
      },
      status: (detail) => {
        this.panel.status(detail);
        if (this.#isHere && detail.ir_ms.p50 !== null) this.frontier.msHere = detail.ir_ms.p50;
      },
      level: (detail) => {
        this.level = detail.level;
        this.frontier.changed(detail);
      },
      effects: (detail) => {
        this.rendered = detail;
        this.effects.show(detail);
      },
      failed: (message) => this.notices.show("stream", message),
      refused: ({ code, message }) => {
        this.notices.show(code, message);
        // A restarted server may offer other scenes, clips and heads.
        if (code === "unknown_hrtf") fetchHeads().then((heads) => this.heads.show(heads), () => {});
        if (code === "unknown_level") fetchFrontier(this.scene.id).then((frontier) => this.#showLevels(frontier), () => {});
      },
    };
    for (const [type, handle] of Object.entries(handlers)) {
      stream.addEventListener(type, ({ detail }) => this.stream === stream && handle(detail));
    }
    stream.addEventListener("state", ({ detail }) => this.coming?.stream === stream && this.#comingState(detail));
    stream.addEventListener("failed", ({ detail }) => this.coming?.stream === stream && this.#stay(detail));
  }

  #listenToControls() {
    find("play").addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    this.frontier.addEventListener("chosen", ({ detail }) => {
      this.comparison.leave();
      this.#useLevel(detail);
    });
    this.comparison.addEventListener("heard", ({ detail: { level, isDry } }) => {
      if (level !== null) {
        this.frontier.chosen = level;
        this.#useLevel(level);
      }
      this.#useDry(isDry);
    });
    this.comparison.addEventListener("left", () => this.#useDry(false));
    this.phone.addEventListener("turned", ({ detail }) => this.world.moveListener(null, this.world.listener.yaw + detail));
    this.phone.addEventListener("denied", () => this.notices.show("phone", "The browser does not tell the page how the phone is turned."));
    find("share").addEventListener("click", () => this.#share());
    window.addEventListener("hashchange", () => location.reload()); // another situation was opened
    this.effects.addEventListener("wished", ({ detail }) => {
      this.heads.used = this.turning.used = this.effects.wishes.output !== "mono";
      if (!this.#renewed()) {
        this.#tell("effects", detail);
        if (this.output !== null) this.output = this.#wantedOutput;
      }
      this.#prepareAgain();
    });
    this.turning.addEventListener("chosen", () => {
      this.#renewed();
      this.#prepareAgain();
    });
    this.heads.addEventListener("chosen", ({ detail }) => {
      if (this.output === "ambisonics") this.#listenWithHead();
      else this.#tell("renew", { head: detail });
      this.#prepareAgain();
    });
    find("volume").addEventListener("input", ({ target }) => this.#setVolume(target.valueAsNumber));
    this.#setVolume(find("volume").valueAsNumber);
    onThemeChange(() => {
      this.paper.recolour();
      this.panel.recolour();
      if (this.scale) this.legend.show(this.scale);
    });
  }

  #listenToOwnSounds() {
    const { own, plan, sources } = this;
    for (const id of ["add-microphone", "add-file"]) find(id).disabled = false;
    find("add-microphone").addEventListener("click", () => own.addMicrophone());
    find("add-file").addEventListener("click", () => find("file").click());
    find("file").addEventListener("change", ({ target }) => {
      for (const file of target.files) own.addFile(file);
      target.value = ""; // so that the same file can be chosen again
    });
    own.addEventListener("refused", ({ detail }) => this.notices.show("own", detail));
    own.addEventListener("added", ({ detail: { name, place } }) => {
      sources.own = own.all;
      if (this.world.isFull) {
        this.notices.show("own", "No more sources fit: choose the sound at one of those that there are.");
        return;
      }
      const { id } = this.world.addEmitter({ clip: name });
      if (place) this.world.moveEmitter(id, place);
    });
    const area = find("plan");
    const bringsFiles = (event) => event.dataTransfer?.types.includes("Files");
    window.addEventListener("dragover", (event) => {
      if (!bringsFiles(event)) return;
      event.preventDefault(); // or the browser opens the file in place of the page
      area.classList.toggle("receives", area.contains(event.target));
    });
    window.addEventListener("dragleave", (event) => event.relatedTarget === null && area.classList.remove("receives"));
    window.addEventListener("drop", (event) => {
      if (!bringsFiles(event)) return;
      event.preventDefault();
      area.classList.remove("receives");
      const place = area.contains(event.target) ? plan.at(event) : null;
      for (const file of event.dataTransfer.files) own.addFile(file, place);
    });
  }

  /** Tells the stream how an emitter is now. */
  #say(emitter) {
    this.#tell("emitter", this.#emitterNow(emitter));
    this.#feed(emitter);
  }

  #remove(id) {
    this.own.stop(id);
    this.#tell("remove", { id });
  }

  /** Plays an emitter's own sound into the stream, if it has one and the stream is there. */
  #feed({ id, clip }) {
    const wanted = isOwn(clip) && this.isFed ? clip : undefined;
    if (this.own.played(id) === wanted) return;
    if (wanted === undefined) {
      this.own.stop(id);
      return;
    }
    const tap = this.player.tap();
    this.#tell("tap", { id, port: tap.port }, [tap.port]);
    this.own.play(id, clip, this.player.context, tap);
  }

  #setVolume(percent) {
    find("volume").style.setProperty("--value", `${percent}%`);
    this.player.volume = (percent / 100) ** 2; // closer to perceived loudness than a linear control
  }

  #showLevels(frontier) {
    this.frontier.show(frontier);
    this.comparison.show(frontier.levels.filter(({ is_offered: isOffered }) => isOffered).reverse());
  }

  /** Whether the stream that is heard is rendered in this browser. */
  get #isHere() {
    return this.stream === this.local;
  }

  /** The stream that a level needs. */
  #streamFor(level) {
    if (level !== HERE) return this.remote;
    if (!this.local) this.#listenToStream((this.local = new LocalWorkerStream()));
    return this.local;
  }

  /** Takes a stream as the one that is heard. */
  #choose(stream) {
    this.stream = stream;
    this.used = this.frontier.chosen;
    this.turning.level = this.#isHere ? "auto" : this.frontier.chosen;
    this.panel.rendersHere = this.turning.rendersHere = this.#isHere;
  }

  async #useLevel(name) {
    if (this.coming || this.#isHere || name === HERE) {
      await pause(SETTLED_MS);
      if (this.frontier.chosen !== name) return; // another was chosen meanwhile
    }
    const stream = this.#streamFor(name);
    this.#callOff();
    if (stream !== this.stream) {
      if (this.playing) this.#prepare(stream);
      else this.#choose(stream);
      return;
    }
    if (this.#isHere) return;
    this.turning.level = this.used = name;
    if (!this.#renewed({ level: name })) this.#tell("level", { name });
  }

  /** Opens a stream beside the one that is heard, which takes its place when it is there. */
  #prepare(stream) {
    const { port1, port2 } = new MessageChannel();
    const slow = setTimeout(() => this.notices.show("coming", `The other level is being prepared. ${GOES_ON}`, { lasting: true }), SLOW_MS);
    this.coming = { stream, ...this.#open(stream, port2), port: port1, slow };
  }

  /** Opens a stream that sends its blocks to a port. Returns the output that it has. */
  #open(stream, port) {
    const isHere = stream === this.local;
    // The menu of turning knows of the level that is heard alone.
    const isTurnedHere = isHere || (this.turning.turns(this.frontier.chosen) && this.effects.wishes.output !== "mono");
    const output = isTurnedHere ? "ambisonics" : this.effects.wishes.output;
    const hello = {
      scene: this.scene.id,
      sampleRate: this.player.sampleRate,
      level: isHere ? undefined : this.frontier.chosen,
      effects: this.effects.wishes.effects,
      doors: isHere ? undefined : this.world.openness,
      ...this.#outputOf(output),
    };
    const emitters = [...this.world.emitters.values()].map((emitter) => this.#emitterNow(emitter));
    stream.tell("open", { url: streamUrl(), key: key(), hello, listener: this.#listenerNow(), emitters, port }, [port]);
    return { output };
  }

  #prepareAgain() {
    if (!this.coming) return;
    const { stream } = this.coming;
    this.#callOff();
    this.#prepare(stream);
  }

  #callOff() {
    if (!this.coming) return;
    const { stream, port } = this.#uncoming();
    stream.tell("close");
    port.close();
  }

  /** What was to come, which has come or will not. */
  #uncoming() {
    const { coming } = this;
    this.coming = null;
    clearTimeout(coming.slow);
    this.notices.clear("coming");
    return coming;
  }

  /** Goes on with what is heard, because what was to come cannot. */
  #stay(reason) {
    this.#callOff();
    this.frontier.chosen = this.used;
    this.notices.show("stream", reason);
  }

  #comingState(detail) {
    const { state, reason, isBusy, needsKey } = detail;
    if (state === "live") this.#adopt(detail);
    else if (state === "refused" && needsKey) this.#prepareWithKey(reason);
    else if (state === "refused") this.#stay(reason);
    else if (state === "waiting") {
      clearTimeout(this.coming.slow);
      const why = isBusy ? "The server has no room yet." : "The server cannot be reached.";
      this.notices.show("coming", `${why} Trying again. ${GOES_ON}`, { lasting: true });
    }
  }

  async #prepareWithKey(reason) {
    const wanted = this.frontier.chosen;
    this.#callOff();
    await askForKey(reason);
    if (this.playing && !this.coming && this.frontier.chosen === wanted) this.#prepare(this.#streamFor(wanted));
  }

  /** Plays the stream that has come, in place of the one that was heard. */
  #adopt(detail) {
    const { stream, output, port } = this.#uncoming();
    const before = this.stream;
    this.#starve();
    this.#choose(stream);
    this.player.take(port);
    before.tell("close");
    this.output = output;
    this.#blank();
    this.steady = false;
    // It counts its poses anew.
    [this.ledger, this.reverberationLedger] = [new PoseLedger(), new PoseLedger()];
    if (output === "ambisonics") this.#listenWithHead();
    this.#feedAll();
    this.#streamState(detail);
  }

  #useDry(isDry) {
    if (isDry === this.isDry) return;
    this.isDry = isDry;
    this.effects.wish(isDry ? DRY : AS_PLANNED);
  }

  /** Takes over what a link says, and gives the scene its first source if the link has none. */
  #restore(shared) {
    const { world, scene, clips } = this;
    for (const [name, openness] of Object.entries(shared?.doors ?? {})) world.setDoor(name, openness);
    if (shared?.listener) world.moveListener(shared.listener.position, shared.listener.yaw);
    const missing = new Set();
    for (const source of shared?.sources ?? []) {
      if (!clips.some(({ name }) => name === source.clip)) missing.add(source.clip);
      else if (!world.isFull) {
        const { id } = world.addEmitter({ ...source, position: scene.emitter.position });
        world.moveEmitter(id, source.position);
      }
    }
    if (missing.size > 0) this.notices.show("situation", `This server has no clip ${[...missing].map((name) => `“${name}”`).join(", ")}.`);
    if (world.emitters.size === 0 && clips.length > 0) world.addEmitter({ clip: clips[0].name, position: scene.emitter.position });
    if (!shared) return;
    const isHere = shared.level === HERE && this.turning.isPossible;
    if (isHere || scene.levels.some(({ name }) => name === shared.level)) this.frontier.chosen = shared.level;
    this.heads.wish = shared.head ?? null;
    this.effects.restore(shared);
    this.heads.used = this.turning.used = this.effects.wishes.output !== "mono";
    this.turning.chosen = shared.turning;
    this.#choose(this.#streamFor(this.frontier.chosen));
  }

  async #share() {
    const { effects, output } = this.effects.wishes;
    const level = this.frontier.chosen;
    const link = linkTo(location.href, {
      scene: this.scene.id,
      rate: this.rate,
      listener: this.world.listener,
      sources: [...this.world.emitters.values()].filter(({ clip }) => !isOwn(clip)),
      level: level === "auto" ? undefined : level,
      output: output === "headphones" ? undefined : output,
      head: this.heads.chosen,
      turning: this.turning.chosen,
      effects,
      doors: this.world.openness,
    });
    history.replaceState(null, "", link);
    try {
      await navigator.clipboard.writeText(link);
      this.notices.show("share", "The link to what you hear is copied.");
    } catch {
      this.notices.show("share", "The address of this page is now the link to what you hear.");
    }
  }

  #listenerNow() {
    const { position, yaw } = this.world.listener;
    return { position: [...position], yaw, at: epochNow() };
  }

  #emitterNow({ id, clip, position, gainDb }) {
    const sound = isOwn(clip) ? { live: true } : { clip };
    return { id, ...sound, position: [...position], gainDb, at: epochNow() };
  }

  #tell(type, detail, transfer = []) {
    this.stream.tell(type, detail, transfer);
    if (WORLDLY.includes(type)) this.coming?.stream.tell(type, detail);
  }

  get #wantedOutput() {
    return this.turning.isHere ? "ambisonics" : this.effects.wishes.output;
  }

  /** What a hello says of an output. Ambisonic sound is decoded here, whatever head the server has. */
  #outputOf(output) {
    const isHere = output === "ambisonics";
    return { output, order: isHere ? ORDER : undefined, head: isHere ? undefined : this.heads.chosen };
  }

  /** Begins another stream if only that can have the output that is wanted now. Returns whether it does. */
  #renewed(changes = {}) {
    const crosses = this.output !== this.#wantedOutput && [this.output, this.#wantedOutput].includes("ambisonics");
    if (!this.playing || this.output === null || !crosses) return false;
    this.output = this.#wantedOutput;
    this.#tell("renew", { ...changes, effects: this.effects.wishes.effects, ...this.#outputOf(this.output) });
    if (this.output === "ambisonics") this.#listenWithHead();
    return true;
  }

  /** Tells the worklet how the head turns. */
  #turnHead() {
    const { yaw } = this.world.listener;
    this.turnedAt = epochNow();
    this.player.turn([0, 0, Math.sin(yaw / 2), Math.cos(yaw / 2)], this.turnedAt);
  }

  /** Gives the worklet the filters of the chosen head. If there are none to be had, the server renders two ears. */
  async #listenWithHead() {
    try {
      const head = this.heads.chosen ?? (await fetchHeads()).default;
      const sampleRate = this.player.sampleRate ?? this.rate ?? rateFor(LIKELY_HZ, this.scene);
      if (head !== this.decoded || sampleRate !== this.decodedHz) {
        const decoder = await fetchDecoder(head, { order: ORDER, sampleRate });
        if ((this.heads.chosen ?? head) !== head) return; // another was chosen meanwhile
        if ((this.player.sampleRate ?? sampleRate) !== sampleRate) return; // the sound card has another
        this.player.listenWith({ filters: decoder.filters, delaySamples: decoder.delay_samples });
        [this.decoded, this.decodedHz] = [head, sampleRate];
      }
      if (this.output === "ambisonics") this.head = head;
    } catch (error) {
      if (this.output !== "ambisonics") return; // it is tried again when it is needed
      if (AWAY.includes(error.code)) {
        await pause(RETRY_MS);
        if (this.output === "ambisonics") this.#listenWithHead();
        return;
      }
      this.notices.show(error.code ?? "decoder", `The sound is turned on the server: ${error.message}`);
      this.turning.giveUp();
      this.#renewed();
    }
  }

  async play() {
    if (this.playing) return;
    this.#setPlaying(true);
    this.#setConnection("connecting", "Connecting");
    let port;
    try {
      port = await this.player.start((cardHz) => this.rate ?? rateFor(cardHz, this.scene));
    } catch (error) {
      this.#setPlaying(false);
      this.#setConnection("refused", "No sound");
      this.notices.show("audio", `Sound could not be started: ${error.message}`, { lasting: true });
      return;
    }
    if (!this.playing) return;
    this.notices.clear("audio");
    this.#choose(this.#streamFor(this.frontier.chosen));
    this.#feedAll();
    this.output = this.#open(this.stream, port).output;
    if (this.output === "ambisonics") this.#listenWithHead();
  }

  /** Plays the visitor's own sounds into the stream that is heard. */
  #feedAll() {
    this.isFed = true;
    for (const emitter of this.world.emitters.values()) this.#feed(emitter);
  }

  async pause() {
    if (!this.playing) return;
    this.#setPlaying(false);
    this.#callOff();
    this.#starve();
    await this.player.pause();
    if (this.playing) return;
    this.#tell("close");
    this.output = null;
    this.#blank();
    this.#setConnection("idle", "Paused");
  }

  /** Ends what plays the visitor's own sounds, and gives the microphone back. */
  #starve() {
    this.isFed = false;
    this.own.stopAll();
  }

  /** Clears the figures of a stream that has ended. */
  #blank() {
    this.panel.rest();
    this.panel.turnsHere = this.turning.isHere;
    this.turnLedger.restart();
    this.frontier.heard = this.level = this.head = null;
    this.rendered = null;
    this.effects.rest();
    this.plan.glow(0, 0);
  }

  #setPlaying(playing) {
    this.playing = playing;
    this.steady = false;
    find("play").setAttribute("aria-pressed", playing);
    find("play-text").textContent = playing ? "Pause" : "Play";
    document.body.classList.toggle("playing", playing);
  }

  #setConnection(state, text) {
    this.connection = state;
    find("connection").dataset.state = state;
    find("connection-text").textContent = text;
  }

  #streamState(detail) {
    if (!this.playing) return;
    const { state, attempt, retryMs, code, reason, isBusy, needsKey } = detail;
    if (state === "connecting" && attempt === 0) {
      this.#setConnection("connecting", "Connecting");
      this.#blank();
    } else if (state === "live") {
      this.#setConnection("live", "Live");
      const { welcome } = detail;
      this.frontier.heard = this.level = this.#isHere ? HERE : welcome.level;
      if (this.#isHere) this.effects.leave();
      this.head = this.output === "ambisonics" ? this.decoded : welcome.hrtf;
      this.panel.turnsHere = this.output === "ambisonics";
      this.world.mostEmitters = welcome.max_emitters;
      // If the page was opened while the server warmed up, it does not have the levels' costs yet.
      fetchFrontier(this.scene.id).then((frontier) => this.#showLevels(frontier), () => {});
      this.notices.clear("connection");
    } else if (state === "waiting") {
      this.steady = false;
      this.#setConnection("waiting", isBusy ? "Waiting for room" : "Reconnecting");
      this.#blank();
      if (isBusy) {
        const seconds = Math.round(retryMs / 1000);
        this.notices.show("connection", `The server has no room for another listener. Trying again in ${seconds} s.`, { lasting: true });
      } else if (code === SHUTTING_DOWN) this.notices.show("connection", "The server is shutting down. The sound goes on at the next one.");
      else if (retryMs >= 1000) this.notices.show("connection", `The connection was lost. ${reason ?? ""} Trying again.`.replace("  ", " "));
    } else if (state === "refused") {
      if (!needsKey) this.notices.show("connection", reason, { lasting: true });
      this.#setPlaying(false);
      this.#callOff();
      this.#starve();
      const paused = this.player.pause();
      this.output = null;
      this.#blank();
      this.#setConnection("refused", needsKey ? "Needs a key" : "Refused");
      if (needsKey) Promise.all([askForKey(reason), paused]).then(() => this.play());
    }
  }

  /** Fetches the maps of emitters that have moved, and shows the sum of all maps. */
  async map() {
    this.mapping?.abort();
    const emitters = [...this.world.emitters.values()];
    if (emitters.length === 0) return;
    const mapping = new AbortController();
    this.mapping = mapping;
    this.paper.stale = true;
    this.legend.note = "mapping";
    try {
      const grids = [];
      for (const emitter of emitters) grids.push(raised(await this.#grid(emitter, mapping.signal), emitter.gainDb));
      if (mapping.signal.aborted) return;
      const grid = combine(grids);
      this.field = new LoudnessField(grid, this.scene.corners);
      // The scale is kept as long as no source is added or removed, so that maps can be compared by eye.
      if (this.scaled !== emitters.length) [this.scale, this.scaled] = [scaleOf(grid), emitters.length];
      this.paper.show(this.field, this.scale);
      this.legend.show(this.scale);
      const whose = emitters.length > 1 ? "of all sources together" : `of source ${emitters[0].id}`;
      this.legend.note = `${whose}; 0 dB is 1 m in the open`;
      this.#pointNeedle();
    } catch (error) {
      if (error.name === "AbortError") return;
      this.legend.note = "not available";
      this.notices.show("loudness", `No loudness map: ${error.message}`);
    }
  }

  /** Draws a storey: what a plane above its floor cuts, its doors, and its loudness. */
  async #showStorey(storey) {
    const isFirst = this.storey === undefined;
    this.storey = this.plan.storey = storey;
    if (!this.scene.is_mesh) return;
    if (!isFirst) this.map();
    try {
      const lines = await fetchSection(this.scene.id, storey ? storey.floor_m + CUT_M : this.world.listener.position[2]);
      if (this.storey === storey) this.paper.lines = lines;
    } catch (error) {
      this.notices.show("section", `The storey cannot be drawn: ${error.message}`);
    }
  }

  /** What the map of an emitter depends on. */
  #gridKey(emitter) {
    return [placeKey(emitter), this.storey?.floor_m, JSON.stringify(this.world.openness)].join();
  }

  async #grid({ id, position }, signal) {
    const doors = this.world.openness;
    const key = this.#gridKey({ position });
    const known = this.grids.get(id);
    if (known?.key === key) return known.grid;
    const heightM = this.world.listener.position[2];
    const grid = parseGrid(await fetchLoudness(this.scene.id, { position, heightM, doors, signal }));
    this.grids.set(id, { key, grid });
    return grid;
  }

  #pointNeedle = () => {
    if (!this.field) return;
    const hovered = this.hovered && this.field.at(this.hovered);
    if (Number.isFinite(hovered)) this.legend.point(hovered, "here");
    else this.legend.point(this.field.at(this.world.listener.position), "at you");
  };

  #drawLevels = () => {
    if (!this.playing) return;
    this.plan.glow(...this.panel.draw());
    this.plan.ripple();
  };
}

const page = new Page();
const becomeReady = exposeHook(page);
await page.open();
becomeReady();
