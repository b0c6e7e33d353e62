# Plays a stream by client_examples/godot for test_engine_losses.py, and writes what a sound card would play (float32, stereo, 48 kHz) to a
# file. Says meanwhile what becomes of it, and how many samples had been heard by then. While the connection is lost, it adds an emitter. A SHOT
# is as in UnityDriver.cs.
#
#   godot3-server --path client_examples/godot -s godot_losses.gd --url=URL --clip=CLIP --seconds=S --output=PATH --give-up-after=S [--shot=SHOT]
extends SceneTree

const RATE = 48000

var _given = {}
var _recorder = Recorder.new()
var _source = Spatial.new()
var _told = {}
var _is_over = false
var _fullest_s = 0.0


# A listener whose generator is emptied by a sound card of ours.
class Recorder:
	extends "res://nafir/nafir_listener_3.gd"

	var queue = []
	var taken = 0 # of the queue
	var played = 0
	var file = File.new()
	var _last_us = 0
	var _due = 0.0

	func get_frames_available():
		return 4095 - (queue.size() - taken)

	func push_frame(frame):
		queue.append(frame)

	func _play(_player, ears, delta):
		var pace = ears.play(self, delta)
		var now_us = OS.get_ticks_usec()
		if _last_us > 0:
			_due += (now_us - _last_us) * 1e-6 * RATE * pace
		_last_us = now_us
		while played < int(_due) and file.is_open():
			var frame = Vector2()
			if taken < queue.size():
				frame = queue[taken]
				taken += 1
			file.store_float(frame.x)
			file.store_float(frame.y)
			played += 1
		if taken > 100000:
			queue = queue.slice(taken, queue.size())
			taken = 0


func _initialize():
	for word in OS.get_cmdline_args():
		var parts = word.trim_prefix("--").split("=")
		if parts.size() == 2:
			_given[parts[0]] = parts[1]
	_recorder.url = _given.url
	_recorder.scene = "flat"
	_recorder.give_up_after_s = float(_given["give-up-after"])
	_recorder.translation = Vector3(2, 1.5, -2.5)
	_recorder.rotation = Vector3(0, -PI / 2, 0)
	_recorder.file.open(_given.output, File.WRITE)
	_recorder.connect("state_changed", self, "_on_state_changed")
	_source.translation = Vector3(6, 1.5, -3)
	get_root().add_child(_source)
	get_root().add_child(_recorder)
	_recorder.connect("emitter_ended", self, "_on_emitter_ended")
	_recorder.add_emitter("source", _source, _given.clip, -70.0 if _given.has("shot") else 0.0)
	Engine.target_fps = 60


func _on_emitter_ended(id):
	print("ended %s" % id)


func _on_state_changed(state):
	print("state %s %d %s" % [state.capitalize(), _recorder.played, _recorder.core.problem])
	if state == "waiting":
		_recorder.add_emitter("late", _source, _given.clip, -70.0)
	if state == "live":
		for id in _recorder.core._emitters:
			if _recorder.core._emitters[id].start < 0:
				_told.erase(id)
	_is_over = state == "lost" or state == "refused"


func _idle(_delta):
	var core = _recorder.core
	if _given.has("shot") and core._snapshot != "":
		_recorder.add_emitter("over", _recorder, _given.shot, 0.0, {"loop": false, "offset_s": 5, "remove_when_ended": true})
		_recorder.add_emitter("stays", _recorder, _given.shot, 0.0, {"loop": false, "offset_s": 5})
		_recorder.add_emitter("heard", _recorder, _given.shot, 0.0, {"loop": false})
		_given.erase("shot")
	for id in core._emitters:
		if core._emitters[id].start >= 0 and not _told.has(id):
			_told[id] = true
			print("emitter_added %s" % id)
	var seconds = float(_given.seconds)
	var waiting_s = float(core.ears.waiting_frames + _recorder.queue.size() - _recorder.taken) / RATE
	if _recorder.played > (seconds - 1) * RATE:
		_fullest_s = max(_fullest_s, waiting_s)
	if _recorder.played >= seconds * RATE or _is_over:
		_recorder.file.close()
		var counts = core.statistics
		print("end %s %d %d %d %.3f %.4f %d %s" % [
			core.state.capitalize(), counts.reconnections, counts.resumptions, core.ears.underruns, _fullest_s, counts.round_trip_s,
			core.sample_clock, core.level,
		])
		quit()
