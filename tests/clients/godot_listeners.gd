# Plays a stream with several listeners by client_examples/godot for test_engine_listeners.py: a player, a guest near the clip, and one with a
# head that there is not. Says who came and went and what became of the stream, plays until it was lost and is live again, and says how loud
# player and guest were in half a second: before the loss, after it, after the guest was moved to the player, and after it left. Each time it
# waits until that is as it should be, thirty seconds at most.
#
#   godot3-server --path client_examples/godot -s godot_listeners.gd --url=URL --clip=CLIP
extends SceneTree

const RATE = 48000
const HEARD = 1e-3
const WINDOW_S = 0.5
const PATIENCE_S = 30.0

var _given = {}
var _recorder = Recorder.new()
var _source = Spatial.new()
var _guest = Spatial.new()
var _is_there = false # the guest
var _was_refused = false # the other one
var _was_lost = false
var _is_back = false
var _phase = 0
var _phase_s = 0.0
var _window_s = 0.0
var _levels = ""


# What a player of Godot does with frames, emptied by a sound card of ours. Adds up their energy.
class Sink:
	var queue = []
	var taken = 0 # of the queue
	var due = 0.0
	var energy = 0.0
	var played = 0

	func get_frames_available():
		return 4095 - (queue.size() - taken)

	func push_frame(frame):
		queue.append(frame)

	func play(frames):
		due += frames
		while played < int(due):
			if taken < queue.size():
				energy += queue[taken].length_squared()
				taken += 1
			played += 1
		if taken > 100000:
			queue = queue.slice(taken, queue.size())
			taken = 0

	# Of what was played since this was last asked.
	func level():
		var found = sqrt(energy / max(1.0, 2.0 * played))
		energy = 0.0
		due -= played
		played = 0
		return found


class Recorder:
	extends "res://nafir/nafir_listener_3.gd"

	var sinks = {} # by the ears that are played
	var heard = [] # ears of listeners who have left

	func _process(delta):
		for ears in heard:
			_play(null, ears, delta)

	func _play(_player, ears, delta):
		if not sinks.has(ears):
			sinks[ears] = Sink.new()
		sinks[ears].play(delta * RATE * ears.play(sinks[ears], delta))


func _initialize():
	for word in OS.get_cmdline_args():
		var parts = word.trim_prefix("--").split("=")
		if parts.size() == 2:
			_given[parts[0]] = parts[1]
	_recorder.url = _given.url
	_recorder.scene = "flat"
	_recorder.listeners = 2
	_recorder.translation = Vector3(1, 1.5, -2.5)
	_guest.translation = Vector3(4.5, 1.5, -2.5)
	_source.translation = Vector3(5, 1.5, -2.5)
	for each in [_recorder, _guest, _source]:
		each.rotation = Vector3(0, -PI / 2, 0)
		get_root().add_child(each)
	_recorder.connect("state_changed", self, "_on_state_changed")
	_recorder.connect("listener_refused", self, "_on_listener_refused")
	_recorder.core.connect("listener_added", self, "_on_listener_added")
	_recorder.add_listener("guest", _guest)
	_recorder.add_listener("nobody", _source, "no such head")
	_recorder.add_emitter("source", _source, _given.clip)
	Engine.target_fps = 60


func _on_state_changed(state):
	print("state %s" % state.capitalize())
	_was_lost = _was_lost or state == "waiting"
	_is_back = _is_back or (_was_lost and state == "live")


func _on_listener_added(id):
	print("joined %s" % id)
	_is_there = true


func _on_listener_refused(id, problem):
	print("refused %s %s" % [id, problem.split(":")[0]])
	_was_refused = true


func _idle(delta):
	_phase_s += delta
	_window_s += delta
	match _phase:
		0:
			_end_phase((_is_there and _was_refused) or _phase_s > PATIENCE_S)
		1:
			if _await("_are_apart"):
				print("heard")
		2:
			_end_phase(_is_back or _phase_s > PATIENCE_S)
		3:
			_end_phase(_phase_s >= 0.25) # what waited to be played
		4:
			if _await("_are_apart"):
				_guest.translation = _recorder.translation
		5:
			if _await("_are_alike"):
				_recorder.heard.append(_ears_of_guest())
				_recorder.remove_listener("guest")
		6:
			if _await("_is_alone"):
				var core = _recorder.core
				var counts = core.statistics
				print("end %s %d %d%s" % [core.state.capitalize(), counts.reconnections, counts.resumptions, _levels])
				quit()


func _are_apart(own, other):
	return other > 2.0 * own


func _are_alike(own, other):
	return abs(other / own - 1.0) < 0.2


func _is_alone(_own, other):
	return other == 0.0


func _ears_of_guest():
	return _recorder.heard[0] if _recorder.heard else _recorder._others["guest"].ears


# Goes on to the next phase if this one is over, and returns whether it is.
func _end_phase(is_over):
	if is_over:
		_take_levels()
		_phase += 1
		_phase_s = 0.0
	return is_over


# As _end_phase, once a window has levels as they should be, which are noted.
func _await(are_right):
	if _window_s < WINDOW_S:
		return false
	var found = _take_levels()
	if not _end_phase((found[0] > HEARD and call(are_right, found[0], found[1])) or _phase_s > PATIENCE_S):
		return false
	_levels += " %f %f" % found
	return true


# Of player and guest, in the window that ends now.
func _take_levels():
	_window_s = 0.0
	var found = []
	for ears in [_recorder.core.ears, _ears_of_guest()]:
		found.append(_recorder.sinks[ears].level() if _recorder.sinks.has(ears) else 0.0)
	return found
