# Tests client_examples/godot/nafir/nafir_core.gd in GDScript itself, and prints its text messages for test_godot.py. Run by
#
#   godot3-server -s godot_driver.gd --core=PATH --vectors=PATH
#
# It prints "checked N" after N comparisons, and ends with 1 after the first that fails.
extends SceneTree

var _checked = 0
var _told = []


# What a player of Godot does with frames, at a rate of its own.
class Generator:
	var room
	var queue = []

	func _init(frames):
		room = frames

	func get_frames_available():
		return room - queue.size()

	func push_frame(frame):
		queue.append(frame)

	func take(count):
		var taken = []
		for _index in range(min(count, queue.size())):
			taken.append(queue.pop_front())
		return taken


func _initialize():
	var given = {}
	for word in OS.get_cmdline_args():
		var parts = word.trim_prefix("--").split("=")
		if parts.size() == 2:
			given[parts[0]] = parts[1]
	var core = load(given.core)
	var file = File.new()
	file.open(given.vectors, File.READ)
	var vectors = JSON.parse(file.get_as_text()).result
	var is_right = (
		_poses(core, vectors.poses) and _listener(core, vectors.listener) and _dry(core, vectors.dry_blocks)
		and _blocks(core, vectors.audio_blocks) and _texts(core) and _resuming(core) and _doors(core) and _guests(core) and _one_shots(core) and _resampling(core) and _playing(core, 24036) and _playing(core, 23964)
	)
	print("checked %d" % _checked)
	quit(0 if is_right else 1)


func _poses(core, table):
	for each in table:
		var there = each.godot
		var here = each.nafir
		var place = Vector3(there.position[0], there.position[1], there.position[2])
		var turn = Quat(there.rotation[0], there.rotation[1], there.rotation[2], there.rotation[3])
		var pose = core.make_pose(place, turn)
		if not (_near(pose.position, here.position) and _same_turn(pose.orientation, here.orientation)):
			return _fail("pose", each)
		var back = core.position_from_nafir(here.position)
		if not (_near([back.x, back.y, back.z], there.position) and _same_turn(core.orientation_from_nafir(here.orientation), there.rotation)):
			return _fail("pose and back", each)
		# The engine's own idea of ahead, right and up: from its Basis.
		var basis = Basis(turn)
		if not (
			_near(core.position_to_nafir(-basis.z), here.ahead) and _near(core.position_to_nafir(-basis.x), here.left)
			and _near(core.position_to_nafir(basis.y), here.up)
		):
			return _fail("directions", each)
	return true


func _listener(core, wanted):
	var data = core.serialize_listener(int(wanted.pose_id), wanted)
	return _equal("listener", data.data_array.hex_encode(), wanted.hex)


func _dry(core, table):
	for each in table:
		if each.encoding != "s16":
			continue
		var data = core.serialize_dry_block(each.id, int(each.sequence), each.samples)
		if not _equal("dry block", data.data_array.hex_encode(), each.hex):
			return false
	return true


func _blocks(core, table):
	for each in table:
		if each.encoding != "s16":
			continue
		var block = core.parse_block(_buffer(each.hex))
		for name in ["sequence", "pose_id", "reverberation_pose_id", "flags"]:
			if not _equal(name, block[name], int(each[name])):
				return false
		if not _equal("sample_clock", str(block.sample_clock), "1099511627781"): # JSON here has floats
			return false
		for channel in range(each.channels.size()):
			for index in range(block.frames.size()):
				var frame = block.frames[index]
				if not _near([frame[channel]], [each.channels[channel][index]]):
					return _fail("samples", each)
		for size in range(each.hex.length() / 2):
			if not _equal("a damaged block", core.parse_block(_buffer(each.hex.substr(0, 2 * size))), null):
				return false
	return true


func _texts(core):
	var stream = core.new()
	stream.scene = "flat \"1\""
	stream.begin()
	var pose = core.make_pose(Vector3(1.5, 0.25, 2.25), Quat(0, 0, 0, 1))
	stream.set_listener(pose)
	print(to_json(stream.hello()))
	stream.set_emitter("npc-ä", "trumpet", pose, -3.5)
	stream.receive({"type": "of a newer server"})
	stream.receive(null)
	stream.receive({"type": "welcome", "sample_rate": 24000.0, "level": "standard"})
	stream.set_emitter("mine", null, pose, 0.0)
	stream.set_emitter("mine", null, pose, -6.0)
	stream.set_emitter("mine", null, core.make_pose(Vector3(1, 2, 3), Quat(0, 0, 0, 1)), -6.0)
	stream.step(0.1)
	stream.remove_emitter("mine")
	for each in stream.texts:
		print(to_json(each))
	return _equal("a pose was sent", stream.packets.size(), 1)


# More is ordered than is kept for a resumed stream. It goes on if the server has handled what is gone, and begins anew if not.
func _resuming(core):
	for handled in [1101.0, 0.0]:
		var stream = core.new()
		stream.begin()
		stream.receive({"type": "welcome", "sample_rate": 24000.0, "level": "standard", "resume_token": "t"})
		stream.set_emitter("x", "trumpet", core.make_pose(Vector3(), Quat(0, 0, 0, 1)), 0.0)
		for index in range(1100):
			stream.set_gain("x", -0.01 * index)
		stream.lost("a cut")
		stream.set_gain("x", -20.0)
		if not (_equal("first", stream.first_message().type, "resume") and _equal("waits", stream.step(2.0), "connect")):
			return false
		stream.begin()
		stream.receive({
			"type": "welcome", "sample_rate": 24000.0, "level": "standard", "resume_token": "u",
			"resumed": {"handled": handled, "sample_clock": 5000.0, "pose_id": 0.0},
		})
		if handled > 0.0:
			if not (_equal("goes on", stream.step(0.01), "") and _equal("is live", stream.state, "live") and _equal("said", stream.texts.size(), 1)):
				return false
			continue
		if not (_equal("cannot go on", stream.step(0.01), "drop") and _equal("waits", stream.state, "waiting")):
			return false
		stream.lost("dropped")
		if not (_equal("anew", stream.first_message().type, "hello") and _equal("connects", stream.step(2.0), "connect")):
			return false
		stream.begin()
		stream.receive({"type": "welcome", "sample_rate": 24000.0, "level": "standard", "resume_token": "v"})
		if not (_equal("is live", stream.state, "live") and _equal("the emitter is said", stream.texts.size(), 1)):
			return false
	return true


# A door is moved before there is a stream, twice to the same place while there is one, and twice while it is lost. It is as the game has it
# after a resumption, and in a stream that begins anew.
func _doors(core):
	var stream = core.new()
	stream.set_door("kitchen", 0.75)
	stream.begin()
	stream.receive({"type": "welcome", "sample_rate": 24000.0, "level": "standard", "resume_token": "t"})
	if not _equal("at first", _said_of_doors(stream), ["kitchen=0.75"]):
		return false
	stream.set_door("kitchen", 0.5)
	stream.set_door("kitchen", 0.5)
	stream.set_door("attic", 1.0)
	print(to_json(stream.texts[0]))
	if not _equal("while live", _said_of_doors(stream), ["kitchen=0.5", "attic=1"]):
		return false
	stream.lost("a cut")
	stream.set_door("kitchen", 0.25)
	stream.set_door("kitchen", 0.0)
	stream.begin()
	stream.receive({
		"type": "welcome", "sample_rate": 24000.0, "level": "standard", "resume_token": "u",
		"resumed": {"handled": 3.0, "sample_clock": 5000.0, "pose_id": 0.0},
	})
	if not _equal("resumed", _said_of_doors(stream), ["kitchen=0"]):
		return false
	stream.lost("another")
	stream.begin()
	stream.receive({"type": "welcome", "sample_rate": 24000.0, "level": "standard", "resume_token": "v"})
	return _equal("anew", _said_of_doors(stream), ["kitchen=0", "attic=1"])


# A stream with other listeners, over everything that may become of them. Prints what is said and told in each step, a line each, as
# tests/clients/guests.py has it.
func _guests(core):
	var stream = core.new()
	stream.connect("listener_added", self, "_on_listener_added")
	stream.connect("listener_refused", self, "_on_listener_refused")
	var pose = core.make_pose(Vector3(), Quat(0, 0, 0, 1))
	var welcome = {"type": "welcome", "sample_rate": 24000.0, "level": "standard", "resume_token": "t"}
	stream.add_listener("guest", pose, "kemar")
	_print_guests(to_json(stream.first_message()))
	stream.begin()
	stream.receive(welcome)
	_tell(stream)
	stream.receive({"type": "listener_added", "id": "guest", "index": 7.0, "sample_clock": 0.0})
	stream.step(0.02)
	_tell(stream)
	_hear(stream, 0, 3)
	_hear(stream, 7, 7)
	_hear(stream, 9, 11) # of nobody
	_tell(stream)
	stream.receive({"type": "level_changed", "level": "fine", "listener": "guest"})
	_print_guests("%s %s" % [stream.level, stream.add_listener("guest", pose).level])
	stream.add_listener("unheard", pose)
	stream.add_listener("late", pose)
	_tell(stream)
	stream.lost("a cut")
	_print_guests(to_json(stream.first_message()))
	stream.begin()
	var resumed = welcome.duplicate()
	resumed["resumed"] = {
		"handled": 2.0, "sample_clock": 5000.0, "pose_id": 0.0,
		"listeners": [{"id": "guest", "index": 7.0}, {"id": "unheard", "index": 8.0}],
	}
	stream.receive(resumed)
	_tell(stream)
	stream.lost("another")
	stream.begin()
	stream.receive(welcome)
	_tell(stream)
	stream.receive({"type": "error", "code": "server_busy", "message": "no", "listener": "guest", "retry_after_s": 0.5})
	stream.receive({"type": "error", "code": "unknown_hrtf", "message": "no", "listener": "late"})
	stream.receive({"type": "error", "code": "unknown_listener", "message": "no", "listener": "unheard"})
	_tell(stream)
	stream.step(0.6)
	_tell(stream)
	stream.receive({"type": "error", "code": "unknown_message", "message": "no"})
	_tell(stream)
	return true


# Clips that play once, over the loss of their server. Prints what is said and told in each step, a line each, as tests/clients/one_shots.py has
# it.
func _one_shots(core):
	var stream = core.new()
	stream.connect("emitter_ended", self, "_on_emitter_ended")
	var pose = core.make_pose(Vector3(), Quat(0, 0, 0, 1))
	var welcome = {"type": "welcome", "sample_rate": 24000.0, "level": "standard", "resume_token": "t"}
	stream.begin()
	stream.receive(welcome)
	stream.set_emitter("loop", "trumpet", pose, 0.0)
	stream.set_emitter("again", "trumpet", pose, 0.0, {"loop": false})
	_receive_added(stream, "loop", 0.0)
	stream.receive({"type": "snapshot", "snapshot": "sealed", "pose_id": 0.0, "handled": 2.0, "expires_s": 120.0})
	for id in ["over", "stays", "heard", "waiting"]:
		stream.set_emitter(id, "trumpet", pose, 0.0, {"loop": false, "remove_when_ended": id == "over"})
	stream.set_emitter("later", "trumpet", pose, 0.0, {"loop": false, "start_at": 1000000})
	for id in ["again", "over", "stays", "heard"]:
		_receive_added(stream, id, 0.0)
	_receive_added(stream, "later", 1000000.0)
	stream.set_gain("heard", -3.0)
	_receive_ended(stream, "over", true)
	_receive_ended(stream, "stays", false)
	_hear(stream, 0, 0)
	_tell(stream, "shots")
	stream.lost("a cut")
	stream.begin()
	var resumed = welcome.duplicate()
	resumed["resumed"] = {"handled": 2.0, "sample_clock": 5000.0, "pose_id": 0.0}
	stream.receive(resumed)
	_tell(stream, "shots")
	_receive_added(stream, "again", 5120.0)
	_tell(stream, "shots")
	for id in ["again", "over", "heard"]:
		_receive_ended(stream, id, true)
	_tell(stream, "shots")
	stream.lost("another")
	stream.begin()
	resumed["resumed"] = {"handled": 4.0, "sample_clock": 5376.0, "pose_id": 0.0}
	stream.receive(resumed)
	_tell(stream, "shots")
	_receive_added(stream, "waiting", 6000.0)
	_hear(stream, 0, 24)
	stream.lost("a third")
	stream.begin()
	stream.receive(welcome)
	_tell(stream, "shots")
	return true


func _receive_added(stream, id, clock):
	stream.receive({"type": "emitter_added", "id": id, "sample_clock": clock})


func _receive_ended(stream, id, removed):
	stream.receive({"type": "emitter_ended", "id": id, "sample_clock": 0.0, "removed": removed})


func _on_emitter_ended(id):
	_told.append("ended:" + id)


func _on_listener_added(id):
	_told.append("added:" + id)


func _on_listener_refused(id, _problem):
	_told.append("refused:" + id)


func _hear(stream, number, sequence):
	var data = StreamPeerBuffer.new()
	for each in [1, 0, 2, number]:
		data.put_u8(each)
	data.put_u32(sequence)
	data.put_u64(256 * sequence)
	for each in [0, 0, 256]:
		data.put_u32(each)
	for _index in range(2 * 256):
		data.put_16(0)
	stream.receive_block(data)


func _tell(stream, of = "guests"):
	for each in stream.texts:
		var id = each.get("id", each.get("listener"))
		_told.append("%s:%s" % [each.type, id if id != null else ""])
	for each in stream.packets:
		_told.append("pose:%d" % each.data_array[1])
	stream.texts.clear()
	stream.packets.clear()
	_told.sort()
	var line = ""
	for each in _told:
		line += each + " "
	print("%s %s" % [of, line])
	_told.clear()


func _print_guests(line):
	print("guests " + line)


# What waits to be sent of doors; it is taken out.
func _said_of_doors(stream):
	var said = []
	for each in stream.texts:
		if each.type == "set_door":
			said.append("%s=%s" % [each.door, each.openness])
	stream.texts.clear()
	return said


# A microphone's frames at 44.1 kHz become samples at 24 kHz, two frames later.
func _resampling(core):
	var stream = core.new()
	stream.begin()
	stream.receive({"type": "welcome", "sample_rate": 24000.0, "level": "standard"})
	stream.set_emitter("voice", null, core.make_pose(Vector3(), Quat(0, 0, 0, 1)), 0.0)
	stream.receive({"type": "emitter_added", "id": "voice", "sample_clock": 0.0})
	for chunk in range(10):
		var frames = []
		for index in range(441):
			var sample = sin(0.05 * (441 * chunk + index))
			frames.append(Vector2(sample, sample))
		stream.push_dry_frames("voice", frames, 44100.0)
	var found = stream._emitters["voice"].dry
	for index in range(10, found.size()):
		if abs(found[index] - sin(0.05 * (index * 44100.0 / 24000.0 - 2.0))) > 1e-4:
			return _fail("a resampled sample", index)
	return _equal("samples", abs(found.size() - 2400) <= 1, true)


# A server's clock of `rate` samples a second against a player's of 24000, for eight seconds: no gaps, and the pace follows.
func _playing(core, rate):
	var stream = core.new()
	stream.begin()
	stream.receive({"type": "welcome", "sample_rate": 24000.0, "level": "standard"})
	var generator = Generator.new(1920)
	var sent = 0
	var sequence = 0
	var pace = 1.0
	var owed = 0.0
	for tick in range(480):
		while sent < tick * rate / 60.0 + 2048:
			var data = StreamPeerBuffer.new()
			for each in [1, 0, 2, 0]:
				data.put_u8(each)
			data.put_u32(sequence)
			data.put_u64(sent)
			for each in [0, 0, 256]:
				data.put_u32(each)
			for index in range(256):
				data.put_16((sent + index) % 30000)
				data.put_16(0)
			if not _equal("a block", stream.receive_block(data), true):
				return false
			sent += 256
			sequence += 1
		pace = stream.ears.play(generator, 1.0 / 60)
		owed += pace * 400
		owed -= generator.take(int(owed)).size()
		if not _equal("underruns at %d" % rate, stream.ears.underruns, 0):
			return false
		if abs(pace - 1.0) > 0.00201:
			return _fail("pace", pace)
	# The ramp that was sent is what would be played: nothing is lost on the way but what the beginning skipped.
	var rest = generator.take(1920)
	for index in range(1, rest.size()):
		var step = int(round((rest[index].x - rest[index - 1].x) * 32767.0))
		if not _equal("a step", step == 1 or step == -29999, true):
			return false
	return _equal("the pace %f at %d" % [pace, rate], (pace > 1.0001) if rate > 24000 else (pace < 0.9999), true)


func _buffer(hex):
	var data = StreamPeerBuffer.new()
	for index in range(0, hex.length(), 2):
		data.put_u8(("0x" + hex.substr(index, 2)).hex_to_int())
	return data


func _near(found, wanted):
	_checked += 1
	for index in range(wanted.size()):
		if abs(found[index] - wanted[index]) > 2e-6 * max(1.0, abs(wanted[index])):
			return false
	return found.size() == wanted.size()


# A quaternion and its negative are the same turn.
func _same_turn(found, wanted):
	var negative = []
	for each in found:
		negative.append(-each)
	return _near(found, wanted) or _near(negative, wanted)


func _equal(what, found, wanted):
	_checked += 1
	return true if typeof(found) == typeof(wanted) and found == wanted else _fail("%s: %s, not" % [what, found], wanted)


func _fail(what, at):
	printerr("%s %s" % [what, at])
	return false
