# A stream of /v1/stream, protocol 3, without its socket: messages in, messages out, and frames to play. It keeps the wanted state (poses,
# emitters), and says it again in every new connection.
#
# Godot 3 and Godot 4 both read this file: it names nothing that only one of them has, and declares no types.
#
# Nafir: metres; x east, y north, z up. The identity looks along +x. Godot: metres; x right, y up, z back. The identity looks along -z.
# Poses go to the server as {"position": [x, y, z], "orientation": [x, y, z, w]}.

const PROTOCOL = 3
const HALF_ROOT = 0.70710678118654752 # sine and cosine of half a quarter turn
const FULL_SCALE = 32767.0
const ACKNOWLEDGE_EVERY = 4 # blocks
const BLOCKS_AHEAD = 4
const POSE_INTERVAL_S = 0.012
const SILENCE_S = 4.0 # a server that sends audio is never silent for so long
const RETRY_S = [0.25, 0.5, 1.0, 2.0, 4.0]
const MOST_S = 0.25 # what is more than this above the target is skipped
const CORRECTION_S = 10.0
const MOST_CORRECTION = 0.002 # three cents
const SMOOTHING_S = 1.0

var scene = "apartment"
var wanted_rate = 0 # 44100, 48000 or 96000; 0 takes the scene's own
var block_size = 256
var buffer_blocks = 8
var target_s = 0.08 # held back against a network that stalls, and a game that draws slowly

var state = "closed" # connecting, live, waiting, refused
var problem = "" # why the stream was refused or last lost
var sample_rate = 0 # of the stream; 0 before the welcome
var level = ""
var heard_pose_id = 0
var heard_reverberation_pose_id = 0
var underruns = 0
var texts = [] # dictionaries to send
var packets = [] # StreamPeerBuffers to send

var _listener = {"position": [0.0, 0.0, 0.0], "orientation": [0.0, 0.0, 0.0, 1.0]}
var _listener_moved = false
var _emitters = {} # by id
var _pose_id = 0
var _since_poses_s = 0.0
var _silent_s = 0.0
var _wait_s = 0.0
var _attempt = 0
var _was_refused = false
var _retry_after_s = 0.0
var _blocks = [] # of frames, in order
var _first = 0 # frame of the first block that is played next
var _waiting_frames = 0
var _room = 0 # frames that an empty generator takes
var _playing = false
var _smooth = 0.0


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


# Adds an emitter, or moves the one with this id. Without a clip (null) it plays what push_dry gives it.
func set_emitter(id, clip, pose, gain_db):
	if _emitters.has(id) and _emitters[id].clip == clip:
		var emitter = _emitters[id]
		if emitter.gain_db != gain_db:
			emitter.gain_db = gain_db
			_say({"type": "set_gain", "id": id, "gain_db": gain_db})
		if not _same(emitter.pose, pose):
			emitter.pose = pose
			emitter.moved = true
		return
	remove_emitter(id)
	_emitters[id] = {
		"clip": clip, "gain_db": gain_db, "pose": pose, "moved": false,
		"dry": [], "taken": 0, # samples that wait, and how many of them are gone
		"sequence": 0, "start": -1, "sent": 0,
	}
	_add(id)


func remove_emitter(id):
	if _emitters.has(id):
		_emitters.erase(id)
		_say({"type": "remove_emitter", "id": id})


# Takes the next samples of a live emitter, numbers at the stream's rate. Samples that come before the emitter is heard, or while a second
# of them waits, are dropped.
func push_dry(id, samples):
	if not _emitters.has(id) or _emitters[id].start < 0:
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


# ---- the connection, whose socket is another's

func begin():
	state = "connecting"
	_silent_s = 0.0
	_was_refused = false
	_retry_after_s = 0.0


# The first message of a connection.
func hello():
	var message = {
		"type": "hello", "protocol": PROTOCOL, "scene": scene, "block_size": block_size, "encoding": "s16",
		"buffer_blocks": buffer_blocks, "listener": _listener,
	}
	if wanted_rate > 0:
		message["sample_rate"] = wanted_rate
	return message


# The connection has ended, or there came none.
func lost(why):
	if not _was_refused:
		problem = why
	texts.clear()
	packets.clear()
	if _was_refused and _retry_after_s == 0.0:
		state = "refused"
		return
	_attempt = 0 if state == "live" else _attempt + 1
	state = "waiting"
	_wait_s = _retry_after_s if _retry_after_s > 0.0 else RETRY_S[int(min(_attempt, RETRY_S.size() - 1))]


# Time passes. Returns what is to be done: "connect", "drop" (the server is silent) or "".
func step(delta_s):
	if state == "waiting":
		_wait_s -= delta_s
		return "connect" if _wait_s <= 0.0 else ""
	if state == "connecting" or state == "live":
		_silent_s += delta_s
		if _silent_s > SILENCE_S:
			return "drop"
	_since_poses_s += delta_s
	if state == "live" and _since_poses_s >= POSE_INTERVAL_S:
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
			problem = "%s: %s" % [message["code"], message["message"]]
			if state != "live":
				_was_refused = true
				if message.has("retry_after_s") and message["retry_after_s"] != null:
					_retry_after_s = float(message["retry_after_s"])
		"level_changed":
			level = message["level"]
		"emitter_added":
			if _emitters.has(message["id"]):
				_emitters[message["id"]].start = int(message["sample_clock"])


func _welcome(message):
	state = "live"
	sample_rate = int(message["sample_rate"])
	level = message["level"]
	_pose_id = 0
	_listener_moved = true
	_blocks.clear()
	_first = 0
	_waiting_frames = 0
	for id in _emitters:
		_emitters[id].start = -1
		_emitters[id].sequence = 0
		_emitters[id].sent = 0
		_emitters[id].moved = false
		_add(id)


# Takes a binary message in a StreamPeerBuffer. Returns whether it was a block; another kind, or a damaged one, changes nothing.
func receive_block(data):
	_silent_s = 0.0
	var block = parse_block(data)
	if block == null or block.channels != 2:
		return false
	heard_pose_id = block.pose_id
	heard_reverberation_pose_id = block.reverberation_pose_id
	_blocks.append(block.frames)
	_waiting_frames += block.frames.size()
	if block.sequence % ACKNOWLEDGE_EVERY == ACKNOWLEDGE_EVERY - 1:
		_say({"type": "acknowledge", "sequence": block.sequence})
	for id in _emitters:
		_send_dry(id, block)
	return true


# A binary message as {flags, channels, sequence, sample_clock, pose_id, reverberation_pose_id, frames}, or null. `frames` are Vector2 of
# both ears, or arrays of samples where there are not two channels.
static func parse_block(data):
	var size = data.get_size()
	data.seek(0)
	if size < 28 or data.get_u8() != 1:
		return null
	var block = {"flags": data.get_u8(), "channels": data.get_u16(), "sequence": data.get_u32(), "sample_clock": data.get_u64()}
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


static func serialize_listener(pose_id, pose):
	var data = StreamPeerBuffer.new()
	for each in [2, 0, 0, 0]:
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
	var message = {"type": "add_emitter", "id": id, "gain_db": emitter.gain_db}
	message["position"] = emitter.pose.position
	message["orientation"] = emitter.pose.orientation
	if emitter.clip == null:
		message["live"] = true
	else:
		message["clip"] = emitter.clip
	_say(message)


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


func _say(message):
	if state == "live":
		texts.append(message)


func _say_poses():
	for id in _emitters:
		var emitter = _emitters[id]
		if emitter.moved:
			emitter.moved = false
			_pose_id += 1
			_say({
				"type": "move_emitter", "id": id, "pose_id": _pose_id,
				"position": emitter.pose.position, "orientation": emitter.pose.orientation,
			})
	if _listener_moved:
		_listener_moved = false
		_pose_id += 1
		packets.append(serialize_listener(_pose_id, _listener))


# ---- playing

# Gives an AudioStreamGeneratorPlayback what it takes. Returns the pitch_scale of its player, which makes up for the difference between
# the server's clock and the sound card's.
func play(generator, delta_s):
	var free = generator.get_frames_available()
	_room = max(_room, free)
	var target = target_s * sample_rate
	var fill = _waiting_frames + _room - free
	if not _playing:
		if _waiting_frames < target or sample_rate == 0:
			return 1.0
		_playing = true
		_smooth = target
		_skip(_waiting_frames - target)
	elif fill <= 0:
		_playing = false
		underruns += 1
		return 1.0
	elif fill > target + MOST_S * sample_rate:
		_skip(fill - target)
	while free > 0 and _waiting_frames > 0:
		var block = _blocks[0]
		generator.push_frame(block[_first])
		_first += 1
		_waiting_frames -= 1
		free -= 1
		if _first == block.size():
			_blocks.pop_front()
			_first = 0
	_smooth += min(1.0, delta_s / SMOOTHING_S) * (fill - _smooth)
	var correction = (_smooth - target) / (CORRECTION_S * sample_rate)
	return 1.0 + max(-MOST_CORRECTION, min(MOST_CORRECTION, correction))


func _skip(frames):
	frames = int(min(frames, _waiting_frames))
	while frames > 0:
		var some = min(frames, _blocks[0].size() - _first)
		_first += some
		_waiting_frames -= some
		frames -= some
		if _first == _blocks[0].size():
			_blocks.pop_front()
			_first = 0
