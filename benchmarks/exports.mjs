// Exported probes, read by the engines themselves: three.js, Khronos' glTF validator, Filament's WebAssembly build.
// Called by exports.py: node exports.mjs FOLDER; prints one JSON object.
import fs from 'node:fs';
import path from 'node:path';
import { createRequire } from 'node:module';

const folder = process.argv[2];
const require = createRequire(path.join(process.cwd(), 'package.json'));
const { toward } = JSON.parse(fs.readFileSync(path.join(folder, 'lights.json'), 'utf8'));
const normals = toward;

const three = require('three');
const text = fs.readFileSync(path.join(folder, 'probes.json'), 'utf8');
const group = new three.ObjectLoader().parse(JSON.parse(text));
const irradiance = group.children.map((probe) => normals.map((n) => {
  const value = probe.sh.getIrradianceAt(new three.Vector3(...n), new three.Vector3());
  return value.toArray();
}));

const gltf = new Uint8Array(fs.readFileSync(path.join(folder, 'probes.gltf')));
const { issues } = await require('gltf-validator').validateBytes(gltf);

const home = path.dirname(require.resolve('filament'));
const filament = await require('filament')({ wasmBinary: fs.readFileSync(path.join(home, 'filament.wasm')) });
const travel = toward.map((_, k) => {
  const name = `probe_${String(k).padStart(4, '0')}`;
  const lines = fs.readFileSync(path.join(folder, name, 'sh.txt'), 'utf8').trim().split('\n');
  const sh = lines.flatMap((line) => line.match(/\(([^)]*)\)/)[1].split(',').map(Number));
  const direction = filament.IndirectLight.getDirectionEstimate(sh);
  return { direction, color: filament.IndirectLight.getColorEstimate(sh, direction) };
});

console.log(JSON.stringify({
  three: { revision: three.REVISION, irradiance },
  gltf: { errors: issues.numErrors, warnings: issues.numWarnings },
  filament: travel,
}));
process.exit(0);
