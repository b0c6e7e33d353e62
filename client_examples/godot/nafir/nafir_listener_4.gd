# Hears a scene of a Nafir server. Godot 4: a child of the camera, so that it moves with it.
extends Node3D

const Core = preload("nafir_core.gd")

@export var url := "ws://127.0.0.1:8000/v1/stream"
@export var scene := "apartment"
@export var key := "" ## an API key or token, if the server asks for one
@export var buffer_s := 0.08
@export var sample_rate := 48000 ## or 44100 or 96000; 0 takes the scene's own
@export var origin: Node3D ## the node at the scene's origin; empty if that is the world's

var core = Core.new()
var _socket: WebSocketPeer
var _greeted := false
var _nodes := {} # id -> {node, clip, gain_db}
var _player := AudioStreamPlayer.new()


func _ready() -> void:
	core.scene = scene
	core.wanted_rate = sample_rate
	core.target_s = buffer_s
	add_child(_player)
	_open()


## The emitter plays a clip of the server at the node, wherever that moves; with null, what core.push_dry gives it.
func add_emitter(id: String, node: Node3D, clip = null, gain_db := 0.0) -> void:
	_nodes[id] = {"node": node, "clip": clip, "gain_db": gain_db}


func remove_emitter(id: String) -> void:
	_nodes.erase(id)
	core.remove_emitter(id)


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


func _lost(why: String) -> void:
	_socket = null
	core.lost(why)


func _poll() -> void:
	_socket.poll()
	var state := _socket.get_ready_state()
	if state == WebSocketPeer.STATE_OPEN and not _greeted:
		_greeted = true
		_socket.send_text(JSON.stringify(core.hello()))
	while _socket.get_available_packet_count() > 0:
		var packet := _socket.get_packet()
		if _socket.was_string_packet():
			core.receive(JSON.parse_string(packet.get_string_from_utf8()))
		else:
			var data := StreamPeerBuffer.new()
			data.data_array = packet
			core.receive_block(data)
	if state == WebSocketPeer.STATE_CLOSED:
		_lost("closed with %d: %s" % [_socket.get_close_code(), _socket.get_close_reason()])


func _process(delta: float) -> void:
	if _socket != null:
		_poll()
	core.set_listener(pose_of(self))
	for id in _nodes.keys():
		if is_instance_valid(_nodes[id].node):
			core.set_emitter(id, _nodes[id].clip, pose_of(_nodes[id].node), _nodes[id].gain_db)
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
	_play(delta)


func _play(delta: float) -> void:
	if core.sample_rate == 0:
		return
	if _player.stream == null or _player.stream.mix_rate != core.sample_rate:
		var generator := AudioStreamGenerator.new()
		generator.mix_rate = core.sample_rate
		generator.buffer_length = buffer_s
		_player.stream = generator
		_player.play()
	_player.pitch_scale = core.play(_player.get_stream_playback(), delta)


func _exit_tree() -> void:
	if _socket != null:
		_socket.close(1000)
