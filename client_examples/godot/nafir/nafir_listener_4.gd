# Hears a scene of a Nafir server. Godot 4: a child of the camera, so that it moves with it.
extends Node3D

## The stream is "live", was lost and is being tried again ("waiting"), or is over ("refused", "lost"). [code]core.problem[/code] says why.
signal state_changed(state: String)
## The clip of an emitter is over, with its reverberation.
signal emitter_ended(id: String)
## The server does not take a listener beside the first, which is forgotten.
signal listener_refused(id: String, problem: String)

const Core = preload("nafir_core.gd")

@export var url := "ws://127.0.0.1:8000/v1/stream"
@export var scene := "apartment"
@export var key := "" ## an API key or token, if the server asks for one
@export var buffer_s := 0.08
@export var sample_rate := 48000 ## or 44100 or 96000; 0 takes the scene's own
@export var give_up_after_s := 300.0 ## for so long a server that is gone is tried again
@export var listeners := 1 ## there are going to be so many, with this one: the server keeps room for them
@export var origin: Node3D ## the node at the scene's origin; empty if that is the world's

var core = Core.new()
var _socket: WebSocketPeer
var _greeted := false
var _nodes := {} # id -> {node, clip, gain_db, options}
var _others := {} # id -> {node, head, player, ears} of listeners beside this one
var _player := AudioStreamPlayer.new()
var _microphone: AudioEffectCapture # null without one
var _microphone_id := ""


func _ready() -> void:
	core.scene = scene
	core.wanted_rate = sample_rate
	core.target_s = buffer_s
	core.give_up_after_s = give_up_after_s
	core.listeners = listeners
	core.state_changed.connect(func(state: String) -> void: state_changed.emit(state))
	core.emitter_ended.connect(_on_core_emitter_ended)
	core.emitter_refused.connect(_on_core_emitter_refused)
	core.listener_refused.connect(_on_core_listener_refused)
	add_child(_player)
	_open()


## Somebody hears the same emitters at the node, wherever that moves: a player at a split screen, or a spectator. Returns the player of what
## is heard there, whose bus or volume you may change. [param head] is one of the server's; empty for its default.
func add_listener(id: String, node: Node3D, head := "") -> AudioStreamPlayer:
	remove_listener(id)
	var player := AudioStreamPlayer.new()
	_others[id] = {"node": node, "head": head, "player": player, "ears": null}
	add_child(player)
	return player


func remove_listener(id: String) -> void:
	if _others.has(id):
		_others[id].player.queue_free()
		_others.erase(id)
		core.remove_listener(id)


## The emitter plays a clip of the server at the node, wherever that moves; with null, what core.push_dry gives it. [param options] are those
## of core.set_emitter.
func add_emitter(id: String, node: Node3D, clip = null, gain_db := 0.0, options := {}) -> void:
	_nodes[id] = {"node": node, "clip": clip, "gain_db": gain_db, "options": options}


func remove_emitter(id: String) -> void:
	_nodes.erase(id)
	core.remove_emitter(id)


## Adds an emitter that plays the microphone. The project setting [code]audio/driver/enable_input[/code] has to be on.
func add_microphone(id: String, node: Node3D, gain_db := 0.0) -> void:
	if _microphone == null:
		var bus := AudioServer.bus_count
		AudioServer.add_bus(bus)
		AudioServer.set_bus_mute(bus, true) # what is captured here is not heard here
		_microphone = AudioEffectCapture.new()
		AudioServer.add_bus_effect(bus, _microphone)
		var recorder := AudioStreamPlayer.new()
		recorder.stream = AudioStreamMicrophone.new()
		recorder.bus = AudioServer.get_bus_name(bus)
		add_child(recorder)
		recorder.play()
	_microphone_id = id
	add_emitter(id, node, null, gain_db)


## Plays a clip once at the node's present place. Returns the id of its emitter.
func play_once(clip: String, node: Node3D, gain_db := 0.0) -> String:
	return core.play_once(clip, pose_of(node), gain_db)


## Changes a gain over some seconds, linearly in decibels.
func set_gain(id: String, gain_db: float, ramp_s := 0.0) -> void:
	if _nodes.has(id):
		_nodes[id].gain_db = gain_db
	core.set_gain(id, gain_db, ramp_s)


## Opens a door of the scene so far, from 0, shut, to 1.
func set_door(door: String, openness: float) -> void:
	core.set_door(door, openness)


## Lets a clip fade out; [signal emitter_ended] follows.
func stop_emitter(id: String, fade_s := 0.01) -> void:
	core.stop_emitter(id, -1, fade_s)


func pose_of(node: Node3D) -> Dictionary:
	var place := node.global_transform
	if origin:
		place = origin.global_transform.affine_inverse() * place
	return Core.make_pose(place.origin, place.basis.get_rotation_quaternion())


func _open() -> void:
	core.begin()
	core.set_listener(pose_of(self))
	_greeted = false
	_socket = WebSocketPeer.new()
	_socket.inbound_buffer_size = 1 << 20
	_socket.outbound_buffer_size = 1 << 18
	_socket.max_queued_packets = 1024
	if key != "":
		_socket.handshake_headers = PackedStringArray(["Authorization: Bearer %s" % key])
	if _socket.connect_to_url(url) != OK:
		_lost("no connection to %s" % url)


func _lost(why: String, code := 0) -> void:
	_socket = null
	core.lost(why, code)


func _on_core_emitter_ended(id: String) -> void:
	_nodes.erase(id)
	emitter_ended.emit(id)


func _on_core_emitter_refused(id: String, problem: String) -> void:
	push_warning("Nafir: emitter %s: %s" % [id, problem])


func _on_core_listener_refused(id: String, problem: String) -> void:
	remove_listener(id)
	push_warning("Nafir: listener %s: %s" % [id, problem])
	listener_refused.emit(id, problem)


func _poll() -> void:
	_socket.poll()
	var state := _socket.get_ready_state()
	if state == WebSocketPeer.STATE_OPEN and not _greeted:
		_greeted = true
		_socket.send_text(JSON.stringify(core.first_message()))
	while _socket.get_available_packet_count() > 0:
		var packet := _socket.get_packet()
		if _socket.was_string_packet():
			core.receive(JSON.parse_string(packet.get_string_from_utf8()))
		else:
			var data := StreamPeerBuffer.new()
			data.data_array = packet
			core.receive_block(data)
	if state == WebSocketPeer.STATE_CLOSED:
		var code := _socket.get_close_code()
		_lost("closed with %d: %s" % [code, _socket.get_close_reason()], code)


func _process(delta: float) -> void:
	if _socket != null:
		_poll()
	core.set_listener(pose_of(self))
	if _microphone != null:
		var frames := _microphone.get_buffer(_microphone.get_frames_available())
		core.push_dry_frames(_microphone_id, frames, AudioServer.get_mix_rate())
	for id in _others.keys():
		if is_instance_valid(_others[id].node):
			_others[id].ears = core.add_listener(id, pose_of(_others[id].node), _others[id].head)
		else:
			remove_listener(id)
	for id in _nodes.keys():
		if is_instance_valid(_nodes[id].node):
			core.set_emitter(id, _nodes[id].clip, pose_of(_nodes[id].node), _nodes[id].gain_db, _nodes[id].options)
		else:
			remove_emitter(id)
	match core.step(delta):
		"connect":
			_open()
		"drop":
			if _socket != null:
				_socket.close()
			_lost("the server is silent")
	while _socket != null and core.texts.size() > 0:
		_socket.send_text(JSON.stringify(core.texts.pop_front()))
	while _socket != null and core.packets.size() > 0:
		_socket.send(core.packets.pop_front().data_array)
	_play(_player, core.ears, delta)
	for id in _others:
		_play(_others[id].player, _others[id].ears, delta)


func _play(player: AudioStreamPlayer, ears: RefCounted, delta: float) -> void:
	if ears.sample_rate == 0:
		return
	if player.stream == null or player.stream.mix_rate != ears.sample_rate:
		var generator := AudioStreamGenerator.new()
		generator.mix_rate = ears.sample_rate
		generator.buffer_length = buffer_s
		player.stream = generator
		player.play()
	player.pitch_scale = ears.play(player.get_stream_playback(), delta)


func _exit_tree() -> void:
	if _socket != null:
		_socket.close(1000)
