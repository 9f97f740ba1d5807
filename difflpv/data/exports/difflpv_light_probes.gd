# Light probes of difflpv in Godot 4. EXPERIMENTAL: written from Godot's sources, not run in Godot.
# Attach this script to a LightmapGI node at the scene's origin, set "Probes" to light_probes.json
# of the same folder and tick "Apply". Meshes with GI mode "Dynamic" are then lit by the probes.
# What the numbers are stands in the file under "convention". Licence: Apache-2.0.
@tool
extends LightmapGI

@export_file("*.json") var probes := ""
@export var apply := false:
	set(value):
		if value:
			apply_probes()


func _ready() -> void:
	if light_data == null and probes != "":
		apply_probes()


func apply_probes() -> void:
	var parsed: Variant = JSON.parse_string(FileAccess.get_file_as_string(probes))
	if not parsed is Dictionary or not parsed.has("tetrahedra"):
		push_error("difflpv: 'probes' must name a light_probes.json of 'difflpv probes export'")
		return
	var box := PackedFloat32Array(parsed["bounds"])
	var bounds := AABB(Vector3(box[0], box[1], box[2]), Vector3(box[3], box[4], box[5]))
	var numbers := PackedFloat32Array(parsed["points"])
	var points := PackedVector3Array()
	for k in range(0, numbers.size(), 3):
		points.append(Vector3(numbers[k], numbers[k + 1], numbers[k + 2]))
	var coefficients := PackedFloat32Array(parsed["sh"])
	var colors := PackedColorArray()
	for k in range(0, coefficients.size(), 3):
		colors.append(Color(coefficients[k], coefficients[k + 1], coefficients[k + 2]))
	# A node of the tree is six integers: the bits of a plane's four floats, children over and under.
	var planes := PackedFloat32Array(parsed["planes"]).to_byte_array().to_int32_array()
	var children := PackedInt32Array(parsed["children"])
	var tree := PackedInt32Array()
	for k in range(children.size() / 2):
		tree.append_array(planes.slice(4 * k, 4 * k + 4))
		tree.append_array(children.slice(2 * k, 2 * k + 2))
	var data := LightmapGIData.new()
	data.set("probe_data", {
		"bounds": bounds,
		"points": points,
		"sh": colors,
		"tetrahedra": PackedInt32Array(parsed["tetrahedra"]),
		"bsp": tree,
		"interior": true,
		"baked_exposure": 1.0,
	})
	light_data = data
