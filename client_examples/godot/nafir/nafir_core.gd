# A stream of /v1/stream, protocol 3, without its socket: messages in, messages out, and ears to play. It keeps what is wanted (poses,
# listeners, emitters, level). A server that has kept a lost stream goes on with it, and is sent what it had not got; else the stream begins anew.
#
# Godot 3 and Godot 4 both read this file: it names nothing that only one of them has, and declares no types.
#
# Nafir: metres; x east, y north, z up. The identity looks along +x. Godot: metres; x right, y up, z back. The identity looks along -z.
# Poses go to the server as {"position": [x, y, z], "orientation": [x, y, z, w]}.

const Ears = preload("nafir_ears.gd")

const PROTOCOL = 3
const HALF_ROOT = 0.70710678118654752 # sine and cosine of half a quarter turn
const FULL_SCALE = 32767.0
const ACKNOWLEDGE_EVERY = 4 # blocks
const BLOCKS_AHEAD = 4
const POSE_INTERVAL_S = 0.012
const PING_INTERVAL_S = 1.0
const SILENCE_S = 4.0 # a server that sends audio is never silent for so long
const RETRY_S = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 15.0]
const MOST_ORDERS = 1024
# Errors after which the server ends the connection, which not every version of Godot tells.
const LAST_WORDS = ["server_draining", "taken_over", "key_expired", "key_revoked", "stalled", "reads_too_slowly"]
const LATE = 2 # a flag of blocks

# The stream is live, was lost ("waiting", with the reason in `problem`) or is over ("refused", "lost").
signal state_changed(state)
# The clip of an emitter is over, with its reverberation, or cannot be played on after a loss.
signal emitter_ended(id)
signal emitter_refused(id, problem)
# The server has a listener beside the first: also in a connection with which the stream began anew.
signal listener_added(id)
# The server does not take a listener beside the first, which is forgotten.
signal listener_refused(id, problem)

var scene = "apartment"
var wanted_rate = 0 # 44100, 48000 or 96000; 0 takes the scene's own
var block_size = 256
var buffer_blocks = 8
var target_s = 0.08 # held back against a network that stalls, and a game that draws slowly
var listeners = 1 # there are going to be so many, the first one included: the server keeps room for them
var give_up_after_s = 300.0 # for so long a server that is gone is tried again

var state = "closed" # connecting, live, waiting, refused, lost
var problem = "" # why the stream was refused or last lost
var sample_rate = 0 # of the stream; 0 before the welcome
var sample_clock = 0 # of the frame after the newest block; goes on over lost connections
var level = "" # that the first listener hears
var heard_pose_id = 0
var heard_reverberation_pose_id = 0
var ears = Ears.new() # of the first listener
# Counts run over all connections and listeners. A block is skipped by the server, or lost with a connection.
var statistics = {
	"blocks": 0, "blocks_late": 0, "blocks_skipped": 0, "reconnections": 0, "resumptions": 0, "round_trip_s": 0.0,
}
var texts = [] # dictionaries to send
var packets = [] # StreamPeerBuffers to send

var _listener = {"position": [0.0, 0.0, 0.0], "orientation": [0.0, 0.0, 0.0, 1.0]}
var _listener_moved = false
var _others = {} # by id, the listeners beside the first
var _emitters = {} # by id
var _wanted_level = ""
var _doors = {} # by name, how far those are open that were moved
var _doors_moved = {} # names of those that were moved while there was no connection
var _shots = 0
var _pose_id = 0
var _since_poses_s = 0.0
var _ping_id = 0
var _since_ping_s = 0.0
var _frame_s = 0.0 # of the game, to which time is known
var _silent_s = 0.0
var _wait_s = 0.0
var _attempt = 0
var _is_trying = false # while there is a connection that has not been welcomed
var _is_to_drop = false # a connection that resumed a stream which cannot go on
var _since_lost_s = 0.0
var _since_block_s = 0.0
var _last_error = null # of the whole stream, in this connection
var _token = "" # with which, or
var _snapshot = "" # with which, the stream is resumed
var _last_block = null # the greatest {sequence, sample_clock} of all listeners' blocks in this stream of the server's
var _clock_offset = 0 # what is added to the server's clock
# The newest messages that the server counts: {message, number, is_over} and the id of the `emitter` that it is about, or null; and how many
# there were.
var _orders = []
var _ordered = 0


# ---- poses

static func position_to_nafir(position):
	return [position.x, -position.z, position.y]


static func orientation_to_nafir(rotation):
	# The exchange of axes, then a quarter turn from "the front is north" to "the front is east".
	var x = rotation.x
	var y = -rotation.z
	var z = rotation.y
	var w = rotation.w
	return [HALF_ROOT * (x + y), HALF_ROOT * (y - x), HALF_ROOT * (z + w), HALF_ROOT * (w - z)]


static func position_from_nafir(position):
	return Vector3(position[0], position[2], -position[1])


# The x, y, z and w of a Quat or Quaternion.
static func orientation_from_nafir(orientation):
	var x = orientation[0]
	var y = orientation[1]
	var z = orientation[2]
	var w = orientation[3]
	return [HALF_ROOT * (x - y), HALF_ROOT * (z - w), -HALF_ROOT * (x + y), HALF_ROOT * (z + w)]


static func make_pose(position, rotation):
	return {"position": position_to_nafir(position), "orientation": orientation_to_nafir(rotation)}


# ---- what the game wants

func set_listener(pose):
	if not _same(_listener, pose):
		_listener = pose
		_listener_moved = true


# Adds a listener beside the first, who hears the same emitters: a player at a split screen, or a spectator. Returns the ears to play.
# `head` is one of the server's; empty for its default. One with this id is moved.
func add_listener(id, pose, head = ""):
	if not _others.has(id):
		_others[id] = {
			"pose": pose, "head": head, "ears": Ears.new(), "moved": true, "has_been": false,
			"added": null, # the order that adds it
			"number": -1, # in the headers of its blocks; -1 until the server has it
			"is_refused": false, "ask_again_s": 0.0,
		}
		_ask(id)
	move_listener(id, pose)
	return _others[id].ears


# Moves a listener beside the first.
func move_listener(id, pose):
	if _others.has(id) and not _same(_others[id].pose, pose):
		_others[id].pose = pose
		_others[id].moved = true


func remove_listener(id):
	if _others.has(id):
		_others.erase(id)
		_order({"type": "remove_listener", "id": id})


# Adds an emitter, or moves the one with this id. Without a clip (null) it plays what push_dry gives it. `options` are further fields of
# add_emitter: loop, start_at, stop_at, offset_s, loop_start_s, loop_end_s, remove_when_ended, jitter_ms, directivity. Clocks are those of
# `sample_clock`.
func set_emitter(id, clip, pose, gain_db, options = {}):
	if _emitters.has(id) and _emitters[id].clip == clip:
		var emitter = _emitters[id]
		if emitter.gain_db != gain_db:
			set_gain(id, gain_db)
		if not _same(emitter.pose, pose):
			emitter.pose = pose
			emitter.moved = true
		return
	remove_emitter(id)
	_emitters[id] = {
		"clip": clip, "gain_db": gain_db, "pose": pose, "options": options, "moved": false,
		"added": null, # the order that adds it
		"is_stopped": false, "is_refused": false, "ask_again_s": 0.0,
		"was_heard": false, # when a connection was lost
		"has_ended": false, # and the game was told so
		"dry": [], "taken": 0, # samples that wait, and how many of them are gone
		"recent": [0.0, 0.0, 0.0, 0.0], "between": 0.0, # of samples at another rate, and where between the middle two the next one is
		"sequence": 0, "start": -1, "sent": 0,
	}
	_add(id)


# Plays a clip once, as soon as it can be heard or from a clock on. Returns the id of its emitter, which is removed once the clip and its
# reverberation are over.
func play_once(clip, pose, gain_db = 0.0, start_at = -1):
	_shots += 1
	var id = "shot%d" % _shots
	var options = {"loop": false, "remove_when_ended": true}
	if start_at >= 0:
		options["start_at"] = start_at
	set_emitter(id, clip, pose, gain_db, options)
	return id


# Changes a gain over some seconds, linearly in decibels.
func set_gain(id, gain_db, ramp_s = 0.0):
	if _emitters.has(id):
		_emitters[id].gain_db = gain_db
		_order({"type": "set_gain", "id": id, "gain_db": gain_db, "ramp_s": ramp_s}, id)


# Opens a door of the scene so far, from 0, shut, to 1. Call it with each frame while a door swings.
func set_door(door, openness):
	if _doors.get(door) == openness:
		return
	_doors[door] = openness
	if state == "live":
		_order_door(door)
	else:
		_doors_moved[door] = true


func _order_door(door):
	_order({"type": "set_door", "door": door, "openness": _doors[door]})


# Lets a clip fade out from a clock on, or at once. `emitter_ended` follows.
func stop_emitter(id, stop_at = -1, fade_s = 0.01):
	if not _emitters.has(id) or _emitters[id].clip == null:
		return
	_emitters[id].is_stopped = true
	var message = {"type": "stop_emitter", "id": id, "fade_s": fade_s}
	if stop_at >= 0:
		message["stop_at"] = _server_clock(stop_at)
	_order(message, id)


func remove_emitter(id):
	if _emitters.has(id):
		_emitters.erase(id)
		_order({"type": "remove_emitter", "id": id}, id)


# Chooses a quality level, or "auto".
func set_level(name):
	_wanted_level = name
	_order({"type": "set_level", "level": name})


# Takes the next samples of a live emitter, numbers at the stream's rate. Samples that come before the emitter is heard, or while a second
# of them waits, are dropped.
func push_dry(id, samples):
	if state != "live" or not _emitters.has(id) or _emitters[id].start < 0:
		return
	var emitter = _emitters[id]
	if emitter.dry.size() - emitter.taken > sample_rate:
		return
	if emitter.taken > sample_rate:
		var rest = []
		for index in range(emitter.taken, emitter.dry.size()):
			rest.append(emitter.dry[index])
		emitter.dry = rest
		emitter.taken = 0
	for each in samples:
		emitter.dry.append(each)


# The same for frames (Vector2) at another rate, as a microphone has them. Between samples it interpolates.
func push_dry_frames(id, frames, rate):
	if not _emitters.has(id) or sample_rate == 0:
		return
	var emitter = _emitters[id]
	var recent = emitter.recent
	var pace = float(rate) / sample_rate
	var samples = []
	for frame in frames:
		recent.pop_front()
		recent.append(0.5 * (frame.x + frame.y))
		while emitter.between < 1.0:
			var t = emitter.between
			var slope = 0.5 * (recent[2] - recent[0])
			var next_slope = 0.5 * (recent[3] - recent[1])
			var curve = 3.0 * (recent[2] - recent[1]) - 2.0 * slope - next_slope
			var twist = 2.0 * (recent[1] - recent[2]) + slope + next_slope
			samples.append(recent[1] + t * (slope + t * (curve + t * twist)))
			emitter.between += pace
		emitter.between -= 1.0
	push_dry(id, samples)


# ---- the connection, whose socket is another's

func begin():
	if state != "waiting":
		_become("connecting")
	_is_trying = true
	_silent_s = 0.0
	_last_error = null


# The first message of a connection.
func first_message():
	if not _can_resume():
		return hello()
	var message = {"type": "resume", "protocol": PROTOCOL}
	if _token != "":
		message["token"] = _token
	if _snapshot != "":
		message["snapshot"] = _snapshot
	if _last_block != null:
		message["sequence"] = _last_block.sequence
		message["sample_clock"] = _last_block.sample_clock
	return message


func hello():
	var message = {
		"type": "hello", "protocol": PROTOCOL, "scene": scene, "block_size": block_size, "encoding": "s16",
		"buffer_blocks": buffer_blocks, "snapshots": true, "listener": _listener,
	}
	if wanted_rate > 0:
		message["sample_rate"] = wanted_rate
	if _wanted_level != "":
		message["level"] = _wanted_level
	if max(listeners, 1 + _others.size()) > 1:
		message["listeners"] = int(max(listeners, 1 + _others.size()))
	return message


# The connection has ended, with a close code if there was one, or there came none.
func lost(why, code = 0):
	texts.clear()
	packets.clear()
	_is_trying = false
	_is_to_drop = false
	if state == "live":
		_attempt = 0
		_since_lost_s = 0.0
	problem = why
	var advised_s = 0.0
	if _last_error != null:
		problem = "%s: %s" % [_last_error["code"], _last_error["message"]]
		if _last_error.get("retry_after_s") != null:
			advised_s = float(_last_error["retry_after_s"])
		if _last_error["code"] == "unknown_resume_token" and _can_resume():
			_forget() # begins anew
			_wait_s = 0.0
			return
	var was_refused = _last_error != null and (state != "live" or _last_error["code"] in LAST_WORDS)
	if advised_s == 0.0 and (_is_final(code) or was_refused):
		_become("refused")
		return
	# With chance, so that the clients of a server that comes back do not all come at once.
	_wait_s = advised_s if advised_s > 0.0 else RETRY_S[int(min(_attempt, RETRY_S.size() - 1))] * _between(0.5, 1.0)
	_attempt += 1
	_become("waiting" if _since_lost_s + _wait_s <= give_up_after_s else "lost")


# Close codes after which a new connection would do no better.
static func _is_final(code):
	return code in [1000, 1002, 1003, 1007, 1008, 1009, 1010] or (code >= 4400 and code < 4500)


static func _between(least, most):
	return least + (most - least) * (randi() % 1024) / 1024.0


func _can_resume():
	return _token != "" or _snapshot != ""


# Lets go of the stream that there was, so that the next connection begins anew.
func _forget():
	_token = ""
	_snapshot = ""
	_orders.clear()
	_ordered = 0


func _become(next):
	if state != next:
		state = next
		emit_signal("state_changed", next)


# Time passes. Returns what is to be done: "connect", "drop" (the server is silent) or "".
func step(delta_s):
	_frame_s = delta_s
	_since_block_s += delta_s
	if state != "live":
		_since_lost_s += delta_s
	if _is_to_drop:
		return "drop"
	if state == "waiting" and not _is_trying:
		_wait_s -= delta_s
		return "connect" if _wait_s <= 0.0 else ""
	if _is_trying or state == "live":
		_silent_s += delta_s
		if _silent_s > SILENCE_S or (_last_error != null and _last_error["code"] in LAST_WORDS):
			return "drop"
	if state != "live":
		return ""
	_since_ping_s += delta_s
	if _since_ping_s >= PING_INTERVAL_S:
		_since_ping_s = 0.0
		_ping_id += 1
		_say({"type": "ping", "id": _ping_id})
	for id in _emitters:
		var emitter = _emitters[id]
		if emitter.is_refused and emitter.ask_again_s > 0.0:
			emitter.ask_again_s -= delta_s
			if emitter.ask_again_s <= 0.0:
				_add(id)
	for id in _others:
		var other = _others[id]
		if other.is_refused:
			other.ask_again_s -= delta_s
			if other.ask_again_s <= 0.0:
				_ask(id)
	_since_poses_s += delta_s
	if _since_poses_s >= POSE_INTERVAL_S:
		_since_poses_s = 0.0
		_say_poses()
	return ""


# Takes a text message, parsed. One that is of no known type changes nothing.
func receive(message):
	_silent_s = 0.0
	if typeof(message) != TYPE_DICTIONARY or not message.has("type"):
		return
	match message["type"]:
		"welcome":
			_welcome(message)
		"error":
			_refused(message)
		"snapshot":
			_snapshot = message["snapshot"]
			_handled(int(message["handled"]))
		"level_changed":
			if message.get("listener") == null:
				level = message["level"]
			elif _others.has(message["listener"]):
				_others[message["listener"]].ears.level = message["level"]
		"pong":
			if int(message["id"]) == _ping_id:
				statistics.round_trip_s = _since_ping_s + _frame_s
		"listener_added":
			if _enter(message["id"], int(message["index"])):
				emit_signal("listener_added", message["id"])
		"emitter_added":
			if _emitters.has(message["id"]):
				_added(message["id"], int(message["sample_clock"]))
		"emitter_ended":
			if _emitters.has(message["id"]):
				_tell_ended(_end(message["id"], message["removed"]))


func _added(id, clock):
	if _is_over(_emitters[id]):
		_order({"type": "remove_emitter", "id": id}, id) # the server goes by a snapshot from before it was heard, and begins it again
		_tell_ended(_end(id, true))
	else:
		_open(_emitters[id], clock)


# The clip of an emitter is over. The server does not have the emitter any more if it `is_gone`. Returns its id where the game is to be told, in
# an array.
func _end(id, is_gone):
	var emitter = _emitters[id]
	var news = [] if emitter.has_ended else [id]
	emitter.has_ended = true
	if is_gone:
		_emitters.erase(id)
		_end_orders(emitter.added)
	return news


func _tell_ended(ids):
	for id in ids:
		emit_signal("emitter_ended", id)


func _refused(error):
	problem = "%s: %s" % [error["code"], error["message"]]
	if error.get("listener") != null:
		_refused_listener(error["listener"], error)
		return
	var id = error.get("emitter")
	if id == null:
		if error["code"] == "unknown_message":
			_refused_unnamed(error)
		_last_error = error
		return
	if not _emitters.has(id):
		return
	var emitter = _emitters[id]
	if emitter.start < 0:
		emitter.is_refused = true
		emitter.ask_again_s = float(error["retry_after_s"]) if error.get("retry_after_s") != null else 0.0
		emit_signal("emitter_refused", id, problem)
	elif error["code"] == "unknown_emitter" and _plays_once(emitter):
		_tell_ended(_end(id, true)) # its end was said just before the connection was lost


# One who comes back with a new connection is asked for again when the server says; any other is forgotten. Returns whether it was.
func _refused_listener(id, error):
	if not _others.has(id) or _others[id].number >= 0 or error["code"] == "unknown_listener":
		return false
	var other = _others[id]
	if other.has_been and error.get("retry_after_s") != null:
		other.is_refused = true
		other.ask_again_s = float(error["retry_after_s"])
		return false
	_others.erase(id)
	emit_signal("listener_refused", id, problem)
	return true


# A server that is too old to know what was asked does not say about whom it speaks. Had it not known another message, it would have the
# listener, who is removed for that.
func _refused_unnamed(error):
	for id in _others.keys():
		if _others[id].number < 0 and not _others[id].is_refused:
			if _refused_listener(id, error):
				_order({"type": "remove_listener", "id": id})
			return


# The server has a listener beside the first, under this number. Returns whether that is news.
func _enter(id, number):
	if not _others.has(id):
		return false # removed meanwhile
	var other = _others[id]
	var is_new = other.number < 0
	other.number = number
	other.has_been = true
	other.moved = true
	other.ears.level = level
	other.ears.open(sample_rate, target_s)
	return is_new


func _welcome(message):
	sample_rate = int(message["sample_rate"])
	ears.open(sample_rate, target_s)
	level = message["level"]
	_token = message.get("resume_token", "")
	_listener_moved = true
	_is_trying = false
	_attempt = 0
	var resumed = message.get("resumed")
	if resumed != null and int(resumed["handled"]) < _ordered - _orders.size():
		_forget() # some of what was said is gone, so the stream begins anew
		_is_to_drop = true
		return
	if statistics.blocks > 0:
		statistics.reconnections += 1
	state = "live" # so that what follows is said; the game is told once it has been
	var entered = []
	if resumed != null:
		_go_on(int(resumed["handled"]), int(resumed["sample_clock"]), int(resumed["pose_id"]))
		entered = _go_on_hearing(int(resumed["handled"]), resumed.get("listeners"))
	else:
		_begin_anew()
	emit_signal("state_changed", "live")
	for id in entered:
		emit_signal("listener_added", id)


# The server has the stream still, or goes by a snapshot of it: it gets what it has not handled, and where everything is now. What plays once
# and was heard since the snapshot is not begun again.
func _go_on(handled, clock, pose_id):
	statistics.resumptions += 1
	var ended = _end_what_is_over(handled)
	_handled(handled)
	_drop_orders()
	for each in _orders:
		texts.append(each.message)
	for door in _doors_moved:
		_order_door(door)
	_doors_moved.clear()
	_pose_id = int(max(_pose_id, pose_id))
	for id in _emitters:
		var emitter = _emitters[id]
		emitter.moved = true
		if not _is_among(emitter, handled):
			emitter.start = -1 # it is among what is sent again
		# That it is heard may have been said just before the connection was lost.
		elif (emitter.clip == null) if emitter.start >= 0 else not emitter.is_refused:
			_open(emitter, int(max(clock, _server_clock(emitter.options.get("start_at", 0)))))
	_tell_ended(ended)


# Listeners that the server has go on. Those that it should have and has not are asked for again. Returns the ids of those that are news.
func _go_on_hearing(handled, there):
	var numbers = {}
	for each in (there if there != null else []):
		numbers[each["id"]] = int(each["index"])
	var entered = []
	for id in _others:
		var other = _others[id]
		if not _is_among(other, handled):
			continue # it is among what is sent again
		if numbers.has(id):
			# That it is there may have been said just before the connection was lost.
			if _enter(id, numbers[id]):
				entered.append(id)
		elif other.number >= 0:
			other.number = -1 # an error says why it is gone
		elif not other.is_refused:
			_ask(id) # the answer was lost
	return entered


# The stream is a new one of the server's, whose clock is at 0. What plays once and was heard is not begun again.
func _begin_anew():
	var ended = _end_what_is_over(0)
	if ears.next_clock >= 0:
		var away_s = max(0.0, _since_block_s - float(buffer_blocks * block_size) / sample_rate)
		_clock_offset = sample_clock + int(away_s * sample_rate)
	ears.next_clock = -1
	_last_block = null
	_snapshot = ""
	_orders.clear()
	_ordered = 0
	_pose_id = 0
	for door in _doors: # not in the hello: a door that the scene lacks would end the stream
		_order_door(door)
	_doors_moved.clear()
	for id in _others: # before what they are to hear from its beginning
		_others[id].number = -1
		_others[id].ears.next_clock = -1
		_ask(id)
	for id in _emitters.keys():
		var emitter = _emitters[id]
		emitter.start = -1
		emitter.was_heard = false
		emitter.sequence = 0
		emitter.moved = false
		_add(id)
	_tell_ended(ended)


# A connection was lost, and the server of the next one lacks what was ordered after number `handled`. Emitters among that which play once, and
# have ended or were heard, end here. Returns the ids of those of which the game is to be told.
func _end_what_is_over(handled):
	var ended = []
	for id in _emitters.keys():
		var emitter = _emitters[id]
		if emitter.start >= 0 and emitter.start < ears.next_clock:
			emitter.was_heard = true
		if _is_over(emitter) and not _is_among(emitter, handled):
			ended += _end(id, true)
	return ended


func _plays_once(emitter):
	return emitter.clip != null and (emitter.is_stopped or not emitter.options.get("loop", true))


# Whether a server that does not have the emitter is not to begin it again.
func _is_over(emitter):
	return emitter.has_ended or (emitter.was_heard and _plays_once(emitter))


# Whether an emitter or a listener is there after so many orders.
static func _is_among(what, handled):
	return what.added == null or what.added.number <= handled


# The server hears the emitter from a clock on, and has no samples of it yet.
func _open(emitter, clock):
	emitter.start = clock
	emitter.sent = 0
	emitter.taken = emitter.dry.size()


# Takes a binary message in a StreamPeerBuffer. Returns whether it was a block; another kind, or a damaged one, changes nothing.
func receive_block(data):
	_silent_s = 0.0
	var block = parse_block(data)
	if block == null or block.channels != 2:
		return false
	var id = null
	if block.listener > 0:
		id = _id_of(block.listener)
		if id == null:
			return true # of one that was removed meanwhile
	statistics.blocks += 1
	if block.flags & LATE:
		statistics.blocks_late += 1
	if _last_block == null:
		_last_block = {"sequence": 0, "sample_clock": 0}
	_last_block.sequence = int(max(_last_block.sequence, block.sequence))
	_last_block.sample_clock = int(max(_last_block.sample_clock, block.sample_clock))
	_since_block_s = 0.0
	var whose = ears if id == null else _others[id].ears
	statistics.blocks_skipped += whose.take(block)
	if block.sequence % ACKNOWLEDGE_EVERY == ACKNOWLEDGE_EVERY - 1:
		var message = {"type": "acknowledge", "sequence": block.sequence}
		if id != null:
			message["listener"] = id
		_say(message)
	if id != null:
		return true
	heard_pose_id = block.pose_id
	heard_reverberation_pose_id = block.reverberation_pose_id
	sample_clock = ears.next_clock + _clock_offset
	for emitter_id in _emitters:
		_send_dry(emitter_id, block)
	return true


func _id_of(number):
	for id in _others:
		if _others[id].number == number:
			return id
	return null


# A binary message as {flags, channels, listener, sequence, sample_clock, pose_id, reverberation_pose_id, frames}, or null. `frames` are Vector2 of
# both ears, or arrays of samples where there are not two channels.
static func parse_block(data):
	var size = data.get_size()
	data.seek(0)
	if size < 28 or data.get_u8() != 1:
		return null
	var block = {"flags": data.get_u8(), "channels": data.get_u8(), "listener": data.get_u8()}
	block["sequence"] = data.get_u32()
	block["sample_clock"] = data.get_u64()
	block["pose_id"] = data.get_u32()
	block["reverberation_pose_id"] = data.get_u32()
	var count = data.get_u32()
	if block.channels == 0 or size - 28 != 2 * block.channels * count:
		return null
	var frames = []
	for _frame in range(count):
		if block.channels == 2:
			var left = data.get_16() / FULL_SCALE
			frames.append(Vector2(left, data.get_16() / FULL_SCALE))
		else:
			var samples = []
			for _channel in range(block.channels):
				samples.append(data.get_16() / FULL_SCALE)
			frames.append(samples)
	block["frames"] = frames
	return block


# `number` is that of a listener beside the first.
static func serialize_listener(pose_id, pose, number = 0):
	var data = StreamPeerBuffer.new()
	for each in [2, number, 0, 0]:
		data.put_u8(each)
	data.put_u32(pose_id)
	for each in pose.position + pose.orientation:
		data.put_float(each)
	return data


static func serialize_dry_block(id, sequence, samples):
	var name = StreamPeerBuffer.new()
	name.put_utf8_string(id) # its length first
	name.seek(0)
	var length = name.get_u32()
	var data = StreamPeerBuffer.new()
	data.put_u8(3)
	data.put_u8(1)
	data.put_u16(length)
	data.put_u32(sequence)
	data.put_u32(samples.size())
	for index in range(length):
		data.put_u8(name.get_u8())
	while data.get_position() % 4 != 0:
		data.put_u8(0)
	for each in samples:
		data.put_16(int(round(max(-1.0, min(1.0, each)) * FULL_SCALE)))
	return data


func _add(id):
	var emitter = _emitters[id]
	emitter.is_refused = false
	var message = {"type": "add_emitter", "id": id, "gain_db": emitter.gain_db}
	message["position"] = emitter.pose.position
	message["orientation"] = emitter.pose.orientation
	for name in emitter.options:
		message[name] = emitter.options[name]
	for name in ["start_at", "stop_at"]:
		if message.has(name):
			message[name] = _server_clock(message[name])
	if emitter.clip == null:
		message["live"] = true
	else:
		message["clip"] = emitter.clip
	emitter.added = _order(message, id)


func _ask(id):
	var other = _others[id]
	other.is_refused = false
	var message = {"type": "add_listener", "id": id, "position": other.pose.position, "orientation": other.pose.orientation}
	if other.head != "":
		message["hrtf"] = other.head
	other.added = _order(message)


func _server_clock(clock):
	return int(max(0, clock - _clock_offset))


func _send_dry(id, block):
	var emitter = _emitters[id]
	if emitter.clip != null or emitter.start < 0 or block.sample_clock < emitter.start:
		return
	# The server's clock counts: as many samples as it has rendered, and a few blocks ahead.
	var size = block.frames.size()
	var due = block.sample_clock - emitter.start + (1 + BLOCKS_AHEAD) * size
	while emitter.sent < due and emitter.dry.size() - emitter.taken >= size:
		var samples = []
		for index in range(size):
			samples.append(emitter.dry[emitter.taken + index])
		emitter.taken += size
		packets.append(serialize_dry_block(id, emitter.sequence, samples))
		emitter.sequence += 1
		emitter.sent += size


static func _same(a, b):
	for index in range(3):
		if a.position[index] != b.position[index]:
			return false
	for index in range(4):
		if a.orientation[index] != b.orientation[index]:
			return false
	return true


# Says what the server counts: now, or once the stream is resumed. A stream that is yet to begin is told all that is wanted when it does.
# `emitter` is the id of the one that the message is about. Returns the order; null for what is not said.
func _order(message, emitter = null):
	if state != "live" and not _can_resume():
		return null
	_ordered += 1
	var order = {"message": message, "number": _ordered, "emitter": emitter, "is_over": false}
	_orders.append(order)
	if _orders.size() > MOST_ORDERS:
		_orders.pop_front()
	if state == "live":
		texts.append(message)
	return order


# So many orders need not be sent again.
func _handled(count):
	while _orders.size() > 0 and _ordered - _orders.size() < count:
		_orders.pop_front()


# The emitter that an order has added is over and gone: if the order is kept still, neither it nor what was said of the emitter since is sent
# again.
func _end_orders(added):
	if added == null or added.number <= _ordered - _orders.size():
		return
	for each in _orders:
		if each.emitter == added.emitter and each.number >= added.number:
			each.is_over = true


# Lets go of orders that are over. The others have the numbers by which the server is going to count them.
func _drop_orders():
	var orders = []
	_ordered -= _orders.size()
	for each in _orders:
		if not each.is_over:
			_ordered += 1
			each.number = _ordered
			orders.append(each)
	_orders = orders


# Says what a lost connection makes idle.
func _say(message):
	if state == "live":
		texts.append(message)


func _say_poses():
	for id in _emitters:
		var emitter = _emitters[id]
		if emitter.moved and not emitter.is_refused:
			emitter.moved = false
			_pose_id += 1
			_say({
				"type": "move_emitter", "id": id, "pose_id": _pose_id,
				"position": emitter.pose.position, "orientation": emitter.pose.orientation,
			})
	for id in _others:
		var other = _others[id]
		if other.moved and other.number >= 0:
			other.moved = false
			_pose_id += 1
			packets.append(serialize_listener(_pose_id, other.pose, other.number))
	if _listener_moved:
		_listener_moved = false
		_pose_id += 1
		packets.append(serialize_listener(_pose_id, _listener))
