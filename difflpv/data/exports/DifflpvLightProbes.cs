// Light probes of difflpv in Unity. Select light_probes.json in the Project window, then use the menu Tools > difflpv:
//   1. "Create Light Probe Group"   2. Window > Rendering > Lighting > Generate Lighting   3. "Apply To Baked Probes"
// Step 2 makes Unity's tetrahedra; step 3 replaces what Unity baked by the numbers of the file.
// What the numbers are stands in the file under "convention". Licence: Apache-2.0.
using UnityEditor;
using UnityEngine;
using UnityEngine.Rendering;

public static class DifflpvLightProbes
{
    [System.Serializable]
    private class ProbeFile
    {
        public float[] positions;
        public float[] coefficients;

        public int Count { get { return positions.Length / 3; } }

        public Vector3 Position(int probe)
        {
            return new Vector3(positions[3 * probe], positions[3 * probe + 1], positions[3 * probe + 2]);
        }

        public SphericalHarmonicsL2 Harmonics(int probe)
        {
            var harmonics = new SphericalHarmonicsL2();
            for (int i = 0; i < 9; i++)
                for (int channel = 0; channel < 3; channel++)
                    harmonics[channel, i] = coefficients[27 * probe + 3 * i + channel];
            return harmonics;
        }
    }

    [MenuItem("Tools/difflpv/Create Light Probe Group")]
    private static void CreateGroup()
    {
        ProbeFile file = Selected();
        if (file == null) return;
        var positions = new Vector3[file.Count];
        for (int probe = 0; probe < file.Count; probe++) positions[probe] = file.Position(probe);
        var holder = new GameObject("difflpv light probes");
        holder.AddComponent<LightProbeGroup>().probePositions = positions;
        Undo.RegisterCreatedObjectUndo(holder, "Create difflpv light probes");
        Debug.Log("difflpv: " + file.Count + " probes; now generate the lighting, then apply the probes.");
    }

    [MenuItem("Tools/difflpv/Apply To Baked Probes")]
    private static void Apply()
    {
        ProbeFile file = Selected();
        if (file == null) return;
        LightProbes baked = LightmapSettings.lightProbes;
        if (baked == null || baked.count == 0)
        {
            Debug.LogError("difflpv: no baked probes: create the light probe group and generate the lighting first.");
            return;
        }
        // Unity may have merged or reordered probes and may hold other groups: only probes at our positions are replaced.
        SphericalHarmonicsL2[] harmonics = baked.bakedProbes;
        Vector3[] places = baked.positions;
        int replaced = 0;
        for (int k = 0; k < places.Length; k++)
        {
            int nearest = 0;
            for (int probe = 1; probe < file.Count; probe++)
                if ((file.Position(probe) - places[k]).sqrMagnitude < (file.Position(nearest) - places[k]).sqrMagnitude)
                    nearest = probe;
            if ((file.Position(nearest) - places[k]).magnitude > 1e-3f) continue;
            harmonics[k] = file.Harmonics(nearest);
            replaced++;
        }
        baked.bakedProbes = harmonics;
        EditorUtility.SetDirty(baked);
        SceneView.RepaintAll();
        Debug.Log("difflpv: " + replaced + " of " + places.Length + " baked probes replaced by " + file.Count + " probes.");
    }

    private static ProbeFile Selected()
    {
        var asset = Selection.activeObject as TextAsset;
        ProbeFile file = null;
        if (asset != null)
        {
            try { file = JsonUtility.FromJson<ProbeFile>(asset.text); }
            catch (System.ArgumentException) { file = null; }
        }
        if (file == null || file.positions == null || file.coefficients == null || file.positions.Length == 0
            || file.positions.Length % 3 != 0 || file.coefficients.Length != 9 * file.positions.Length)
        {
            Debug.LogError("difflpv: select light_probes.json, written by 'difflpv probes export --format unity'.");
            return null;
        }
        return file;
    }
}
